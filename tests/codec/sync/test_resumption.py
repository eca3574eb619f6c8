"""After a restart, codes that the other side still holds are sent as checksums."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import (
    AGENT_KINDS,
    KEYFRAME_KINDS,
    CameraIntrinsics,
    Key,
    NewLandmarks,
    RefinedLandmarks,
    SubmapPlacement,
    WireError,
)
from kiteline_codec.schema.owners import submap_of
from kiteline_codec.sync import resumption
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_core.ids import keyframe_id, submap_id

STEP_NS = 25_000_000
# without the agent's own keyframes, of which only those of its present boot are listed
kinds = st.sampled_from([kind for kind in range(7, 63) if kind not in KEYFRAME_KINDS & AGENT_KINDS])
keys = st.builds(Key, kinds, st.integers(0, 2**61), st.integers(0, 65535))


def values(boot: int, seed: int = 0) -> dict[Key, bytes]:
    """What an agent says of 30 keyframes."""
    random = np.random.default_rng(seed)
    submap = submap_id(1, boot, 0)
    ids = [keyframe_id(submap, i) for i in range(30)]
    return {Key(NewLandmarks.KIND, k, part): random.bytes(400) for k in ids for part in range(3)}


def talk(a: Endpoint, b: Endpoint, begin_ns: int, steps: int = 60, lose: float = 0.0, seed: int = 0) -> int:
    """Let two ends talk. Returns the bytes that a sent."""
    random = np.random.default_rng(seed)
    sent = 0
    for n in range(steps):
        now_ns = begin_ns + n * STEP_NS
        for one, other in ((a, b), (b, a)):
            while (packet := one.poll(now_ns)) is not None:
                sent += len(packet) if one is a else 0
                if random.random() >= lose:
                    other.receive(packet, now_ns)
    return sent


OF_BOOT_4, OF_BOOT_5 = (resumption.agent_session(1, boot) for boot in (4, 5))


def end(session: int) -> Endpoint:
    return Endpoint(SyncConfig(budget_bytes=8000), session, coder=ResidualCoder())


@pytest.mark.parametrize("lose", [0.0, 0.3])
def test_a_base_that_kept_everything_is_sent_checksums(lose: float) -> None:
    agent, base = end(OF_BOOT_4), end(1)
    mine = values(boot=4)
    for key, code in mine.items():
        agent.put(key, code)
    first = talk(agent, base, 0, 400, lose)
    assert base.peer_values() == mine
    second = end(2)
    second.resume(mine)
    again = talk(agent, second, 400 * STEP_NS, 400, lose, seed=1)
    assert second.peer_values() == mine
    assert agent.digest_equal and second.digest_equal
    assert second.stats.mismatches == agent.stats.mismatches == 0
    assert again < (0.2 if lose == 0.0 else 0.9) * first


def test_only_what_is_missing_or_new_goes_whole() -> None:
    agent, mine = end(OF_BOOT_4), values(boot=4)
    for key, code in mine.items():
        agent.put(key, code)
    base = end(2)
    held = dict(list(mine.items())[:60])
    changed = next(iter(held))
    base.resume({**held, changed: b"something else that was said before"})
    talk(agent, base, 0, 200)
    assert base.peer_values() == mine
    assert agent.digest_equal and base.digest_equal


def test_what_the_base_wrote_is_not_sent_again_to_an_agent_that_goes_on() -> None:
    agent, base, again = end(OF_BOOT_4), end(1), end(2)
    own = {Key(RefinedLandmarks.KIND, keyframe_id(submap_id(1, 4, 0), i)): bytes([i]) * 300 for i in range(40)}
    for side in (base, again):
        for key, code in own.items():
            side.put(key, code)
    first = talk(base, agent, 0, 200)
    second = talk(again, agent, 200 * STEP_NS, 200)
    assert agent.peer_values() == own
    assert second < 0.3 * first
    assert again.digest_equal


def test_values_that_are_gone_leave_an_endpoint_when_its_agent_starts_again() -> None:
    base = Endpoint(SyncConfig(), 1, coder=ResidualCoder(), claimed_bytes=lambda key, code: 100)
    base.received.claims.earned = 1 << 20
    gone: set[int] = set()
    base.received.earlier.is_gone = lambda key: submap_of(key) in gone
    sizes = []
    for order, boot in enumerate(range(4, 9), start=1):
        agent = end(resumption.agent_session(order, boot))
        for key, code in values(boot).items():
            agent.put(key, code)
        base.put(Key(RefinedLandmarks.KIND, keyframe_id(submap_id(1, boot, 0), 3)), bytes(40))
        talk(agent, base, order * 10**10, 400)
        assert base.peer_values() == values(boot) and base.digest_equal
        got = base.received
        sizes.append((len(base.earlier_values()), got.earlier.bytes, got.claims.bytes, len(base.own_values())))
        gone.add(submap_id(1, boot, 0))
    assert sizes == [(0, 0, 9000, 1)] * 5


def test_another_boot_gets_no_summary() -> None:
    old = values(boot=4)
    assert resumption.summaries(old, OF_BOOT_4) and not resumption.summaries(old, OF_BOOT_5)


@given(st.dictionaries(keys, st.binary(min_size=16, max_size=40), max_size=150))
def test_summaries_are_read_as_written(known: dict[Key, bytes]) -> None:
    summaries = resumption.summaries(known, 1)
    read: dict[Key, int] = {}
    held = resumption.Resumable()
    for code in summaries.values():
        read.update(resumption.read_summary(code))
        assert held.take(code)
    assert read.keys() == known.keys()
    assert held.standing.keys() == {key for key in known if key.kind == SubmapPlacement.KIND}
    for key, code in known.items():
        form = held.reference_to(key, code)
        assert form is not None
        assert resumption.resolve(form, code) == code
        assert held.reference_to(key, code + b"!") is None
        with pytest.raises(WireError):
            resumption.resolve(form, code + b"!")


def test_placements_are_listed_first_however_short_they_are() -> None:
    placements = {Key(SubmapPlacement.KIND, submap): b"short" for submap in range(3)}
    known = {**values(boot=4), Key(CameraIntrinsics.KIND, 1): b"short", **placements}
    listed = list(resumption.read_summary(resumption.summaries(known, OF_BOOT_4)[Key(resumption.SUMMARY_KIND, 0)]))
    assert listed[:3] == sorted(placements, reverse=True)
    assert all(len(known[key]) >= 16 for key in listed[3:])


def test_placements_that_are_looked_at_in_each_step_are_bounded() -> None:
    known = {Key(SubmapPlacement.KIND, submap): b"" for submap in range(3000)}
    held = resumption.Resumable()
    assert all(held.take(code) for code in resumption.summaries(known, 1).values())
    assert list(held.standing) == sorted(known, reverse=True)[:1024]


@pytest.mark.parametrize("lose", [0.0, 0.4])
@pytest.mark.parametrize("shares_first", [False, True])
def test_a_session_removes_what_an_earlier_one_shared(lose: float, shares_first: bool) -> None:
    """One that had put the value and sent nothing of it yet told nobody: the peer went on with it."""
    base, agent, key = end(1), end(OF_BOOT_4), Key(SubmapPlacement.KIND, 5)
    base.put(key, b"here")
    talk(base, agent, 0, 60, lose)
    second = end(2)
    talk(second, agent, 60 * STEP_NS, 60, lose, seed=1)
    assert second.standing == (key,) and agent.earlier_values() == {key: b"here"}
    if shares_first:
        second.put(key, b"here")
    second.remove(key)
    talk(second, agent, 120 * STEP_NS, 400, lose, seed=2)
    assert not second.standing and not agent.earlier_values() and not agent.peer_values()
    assert second.digest_equal and agent.digest_equal
    second.put(key, b"here")  # whole: the agent holds it no more
    talk(second, agent, 520 * STEP_NS, 400, lose, seed=3)
    assert agent.peer_values() == {key: b"here"} and second.digest_equal
    assert agent.stats.rejected == 0


@given(st.binary(max_size=60))
def test_any_bytes_are_a_summary_or_an_error(noise: bytes) -> None:
    with contextlib.suppress(WireError):
        resumption.read_summary(noise)

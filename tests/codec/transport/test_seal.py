"""Seals: only what a key's holder wrote, once, goes through."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_codec.transport import seal
from kiteline_codec.transport.seal import Direction, Opener, Sealer, Suite, fingerprint, seal_bytes

KEY, OTHER = bytes(range(32)), bytes(range(1, 33))
GOLDEN = ("03050100010203040506072ffcf28162b332eafff82dbe848abe93230b6d46", "8305016b6974651c305abc036f3490")
SUITES = pytest.mark.parametrize("suite", list(Suite))


def sealer(suite: Suite, boot: int = 5, key: bytes = KEY, agent: int = 3) -> Sealer:
    return Sealer(key, agent, boot, Direction.UP, suite, lambda n: bytes(range(n)))


def opener() -> Opener:
    return Opener({3: KEY, 4: OTHER}, Direction.UP)


def test_golden_bytes() -> None:
    assert sealer(Suite.TAGGED).seal(b"kite").hex() == GOLDEN[1]
    assert sealer(Suite.ENCRYPTED).seal(b"kite").hex() == GOLDEN[0]


@SUITES
def test_a_packet_goes_through_once(suite: Suite) -> None:
    ours, theirs = sealer(suite), opener()
    sealed = [ours.seal(bytes([i]) * i) for i in range(20)]
    for i in [*range(0, 20, 2), *range(1, 20, 2)]:
        assert theirs.open(sealed[i]) == (3, bytes([i]) * i)
        assert theirs.open(sealed[i]) is None
    assert theirs.counters.opened == theirs.counters.replayed == 20
    assert max(map(len, sealed)) - 19 <= seal_bytes(suite)
    for agent in (62, 63, 255):
        most = Sealer(KEY, agent, (1 << 42) - 1, Direction.UP, suite)
        most._counter = (1 << 28) - 2
        assert len(most.seal(b"")) == seal_bytes(suite, agent)
    assert seal_bytes(suite, 62) == seal_bytes(suite) == seal_bytes(suite, 63) - 1


@SUITES
def test_agents_of_one_and_of_two_bytes_are_told_apart(suite: Suite) -> None:
    keys = {agent: bytes([agent]) * 32 for agent in (0, 62, 63, 64, 127, 255)}
    theirs = Opener(keys, Direction.UP)
    for agent, key in keys.items():
        sealed = Sealer(key, agent, 5, Direction.UP, suite).seal(b"kite")
        assert theirs.open(sealed) == (agent, b"kite")
        assert seal.read_head(sealed) == (suite, Direction.UP, agent)
        assert seal.read_head(sealed[: int(agent >= 63)]) is None
        if agent >= 63:
            assert theirs.open(sealed[:1] + bytes([62]) + sealed[2:]) is None
            assert theirs.counters.truncated == 1 and theirs.refusal == "truncated"
            theirs.counters.truncated, theirs.refusal = 0, ""


@SUITES
@given(st.binary(min_size=1, max_size=60), st.data())
def test_no_changed_packet_goes_through(suite: Suite, packet: bytes, data: st.DataObject) -> None:
    sealed = bytearray(sealer(suite).seal(packet))
    theirs = opener()
    if data.draw(st.booleans()):
        sealed[data.draw(st.integers(0, len(sealed) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    else:
        del sealed[data.draw(st.integers(0, len(sealed) - 1)) :]
    assert theirs.open(bytes(sealed)) is None
    assert theirs.counters.refused == 1


@given(st.binary(max_size=100))
def test_any_bytes_are_refused_and_counted(data: bytes) -> None:
    theirs = opener()
    assert theirs.open(data) is None
    assert theirs.counters.refused == 1


@SUITES
def test_strangers_directions_and_other_keys_are_refused(suite: Suite) -> None:
    theirs = opener()
    assert theirs.open(sealer(suite, agent=9).seal(b"x")) is None
    assert theirs.open(Sealer(KEY, 3, 5, Direction.DOWN, suite).seal(b"x")) is None
    assert theirs.counters.unknown == 2
    assert theirs.open(sealer(suite, key=OTHER).seal(b"x")) is None
    assert theirs.counters.forged == 1
    assert theirs.counters.by_agent == {9: 1, 3: 2}


@SUITES
def test_a_restart_goes_on_and_what_came_before_it_is_old(suite: Suite) -> None:
    before, after, theirs = sealer(suite, 5), sealer(suite, 6), opener()
    early, late = before.seal(b"1"), before.seal(b"2")
    assert theirs.open(early) is not None
    assert theirs.open(after.seal(b"3")) == (3, b"3")
    assert theirs.open(late) is None
    assert theirs.counters.replayed == 1
    assert theirs.boots == {3: 6}
    again = Opener({3: KEY}, Direction.UP, theirs.boots)
    assert again.open(late) is None
    assert again.open(after.seal(b"4")) is not None


@SUITES
def test_a_forged_packet_does_not_move_the_window(suite: Suite) -> None:
    theirs = opener()
    assert theirs.open(sealer(suite, boot=1 << 30, key=OTHER).seal(b"x")) is None
    assert theirs.open(sealer(suite).seal(b"x")) is not None


@SUITES
def test_what_is_too_late_is_refused(suite: Suite) -> None:
    ours, theirs = sealer(suite), opener()
    late = ours.seal(b"late")
    for _ in range(seal.WINDOW_PACKETS - 1):
        last = ours.seal(b"")
    assert theirs.open(last) is not None
    assert theirs.open(late) is not None
    ours, theirs = sealer(suite), opener()
    late = ours.seal(b"late")
    for _ in range(seal.WINDOW_PACKETS):
        last = ours.seal(b"")
    assert theirs.open(last) is not None
    assert theirs.open(late) is None


def test_no_nonce_comes_twice() -> None:
    nonces = {
        seal._nonce(suite << 7 | direction << 6 | agent, boot, counter)
        for suite in Suite for direction in Direction for agent in (0, 1, 63) for boot in (0, 1, 256)
        for counter in (1, 2, 256, 65536)
    }  # fmt: skip
    assert len(nonces) == 2 * 2 * 3 * 3 * 4


def test_a_boot_that_comes_again_meets_another_key() -> None:
    first, again = (Sealer(KEY, 3, 5, Direction.UP, Suite.ENCRYPTED) for _ in range(2))  # as on two cloned cards
    a, b = first.seal(bytes(40)), again.seal(bytes(40))
    assert a[:3] == b[:3] and a[3:11] != b[3:11]
    assert a[11:] != b[11:]  # equal bytes under equal nonces: one keystream would show
    theirs = opener()
    assert theirs.open(a) == (3, bytes(40)) and theirs.open(b) is None
    assert theirs.open(again.seal(b"2")) == (3, b"2")


@SUITES
def test_a_raised_boot_goes_on_and_lower_ones_are_ignored(suite: Suite) -> None:
    ours, theirs = sealer(suite), opener()
    assert theirs.open(ours.seal(b"1")) is not None
    ours.raise_to(900)
    ours.raise_to(6)
    assert theirs.open(ours.seal(b"2")) == (3, b"2")
    assert theirs.boots == {3: 900}


@SUITES
def test_after_a_change_of_keys_nothing_under_the_old_one_goes_through(suite: Suite) -> None:
    old, theirs = sealer(suite), opener()
    recorded = old.seal(b"1")
    assert theirs.open(recorded) is not None
    theirs.set_key(3, OTHER)
    assert theirs.open(recorded) is None and theirs.open(old.seal(b"2")) is None
    new = sealer(suite, key=OTHER)
    assert theirs.open(new.seal(b"3")) == (3, b"3")
    theirs.set_key(3, None)
    assert theirs.open(new.seal(b"4")) is None


def test_encrypted_packets_tell_nothing() -> None:
    assert b"secret" not in sealer(Suite.ENCRYPTED).seal(b"secret" * 5)


def test_bad_keys_and_numbers_are_errors() -> None:
    with pytest.raises(ValueError, match="32 bytes"):
        Sealer(b"short", 0, 0, Direction.UP, Suite.TAGGED)
    with pytest.raises(ValueError, match="boot"):
        Sealer(KEY, 0, -1, Direction.UP, Suite.TAGGED)
    ours = sealer(Suite.TAGGED)
    ours._counter = (1 << 40) - 1
    with pytest.raises(OverflowError):
        ours.seal(b"")
    assert fingerprint(KEY) != fingerprint(OTHER)

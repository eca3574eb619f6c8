"""Records from one end to the other: coded and plain."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_codec.channel import CodedChannel, RecordChannel, coded_channel, plain_pair
from kiteline_codec.schema import (
    CachedKeyframe,
    CachedLandmarks,
    GridTile,
    Key,
    KeyframePose,
    LivePose,
    Observations,
    Record,
    RemovedObservations,
    SubmapPlacement,
    messages,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, keyframe_id, submap_id

POSE = KeyframePose(KeyframeId(7), se3.exp(np.array([1.00003, 2.0, 3.0, 0.1, 0.2, 0.3])))


def cross(a: RecordChannel, b: RecordChannel, ticks: int = 10) -> tuple[list[Record], list[Key]]:
    """What b learns from a."""
    records: list[Record] = []
    for tick in range(ticks):
        now_ns = tick * 50_000_000
        records += b.receive(a.poll(now_ns), now_ns)
        a.receive(b.poll(now_ns), now_ns)
    return records, b.take_removed()


def test_observations_are_not_decoded_for_their_writer_but_shared_and_noted() -> None:
    a, b = CodedChannel(SyncConfig(), 1), CodedChannel(SyncConfig(), 1)
    a.noting = True
    index, uv = np.arange(2, dtype=np.uint16), np.array([[10.01, 20.0], [30.0, 40.0]], np.float32)
    seen = Observations(KeyframeId(9), 0, index, uv, np.zeros(2, np.float32), np.zeros(2, np.uint8), np.array([5, 6]))
    assert a.put(seen) is seen
    assert a.take_noted() == {messages.key(seen): messages.encode(seen)}
    (got,), _ = cross(a, b)
    assert isinstance(got, Observations)
    assert 0 < np.abs(got.uv - uv).max() <= 1 / 32  # quantised
    assert np.array_equal(got.point, seen.point)


def test_coded_records_arrive_as_the_writer_was_told() -> None:
    a, b = CodedChannel(SyncConfig(), 1), CodedChannel(SyncConfig(), 1)
    kept = a.put(POSE)
    assert isinstance(kept, KeyframePose)
    assert np.abs(kept.T_m_k - POSE.T_m_k).max() > 0
    (got,), removed = cross(a, b)
    assert isinstance(got, KeyframePose)
    assert np.array_equal(got.T_m_k, kept.T_m_k)
    assert removed == []
    assert a.endpoint.digest_equal
    again = a.put(kept)
    assert isinstance(again, KeyframePose)
    assert np.array_equal(again.T_m_k, kept.T_m_k)
    assert a.endpoint.digest_equal  # nothing new
    a.remove(messages.key(POSE))
    assert cross(a, b) == ([], [messages.key(POSE)])
    assert a.stats.values == b.stats.values == 0


def test_values_of_another_schema_are_counted() -> None:
    a, b = CodedChannel(SyncConfig(), 1), CodedChannel(SyncConfig(), 1)
    a.endpoint.put(Key(50, 1), b"of the future")
    a.endpoint.put(Key(KeyframePose.KIND, 1), b"damaged too")
    a.put(POSE)
    records, _ = cross(a, b)
    assert len(records) == 1
    assert b.undecodable == 2


def test_plain_records_pass_as_they_are() -> None:
    a, b = plain_pair()
    removed = RemovedObservations(KeyframeId(1), np.array([3], np.uint16))
    assert a.put(POSE) is POSE
    b.put(removed)
    assert a.poll(0) == []
    (got,) = b.receive([], 0)
    assert got is POSE
    (got,) = a.receive([], 0)
    assert got is removed
    a.put(POSE)
    a.remove(messages.key(POSE))
    assert b.receive([], 0) == []
    assert b.take_removed() == [messages.key(POSE)]
    assert b.receive([], 0) == []


def test_a_thin_link_carries_corrections_then_cached_keyframes_then_tiles() -> None:
    config = SyncConfig(packet_bytes=220, overhead_bytes=7, budget_bytes=500)
    a, b = CodedChannel(config, 1), CodedChannel(config, 1)
    rng = np.random.default_rng(0)
    cross(a, b)  # greetings
    index, flat = np.arange(6, dtype=np.uint16), np.zeros(6, np.uint8)
    uv, depth = rng.uniform(0, 400, (6, 2)).astype(np.float32), np.full(6, 0.2, np.float32)
    a.put(GridTile(0, 0, 0, 0.1, rng.integers(0, 8, (64, 64)).astype(np.int8)))
    for k in range(3):
        a.put(CachedKeyframe(KeyframeId(k), SubmapId(0), POSE.T_m_k))
        described = rng.integers(0, 256, (6, 32), dtype=np.uint8)
        a.put(CachedLandmarks(KeyframeId(k), 0, index, uv, depth, flat, flat, described))
    for k in range(6):
        a.put(KeyframePose(KeyframeId(100 + k), POSE.T_m_k))
    a.put(SubmapPlacement(SubmapId(0), POSE.T_m_k))
    order: list[str] = []
    for tick in range(20, 300):
        now_ns = tick * 50_000_000
        order += [type(r).__name__ for r in b.receive(a.poll(now_ns), now_ns)]
        a.receive(b.poll(now_ns), now_ns)
    last = {
        name: max(i for i, n in enumerate(order) if n == name)
        for name in ("KeyframePose", "SubmapPlacement", "CachedLandmarks", "GridTile")
    }
    first = {name: order.index(name) for name in last}
    assert max(last["KeyframePose"], last["SubmapPlacement"]) < first["CachedLandmarks"]
    assert last["CachedLandmarks"] < first["GridTile"]
    assert a.arrived(messages.key(CachedKeyframe(KeyframeId(0), SubmapId(0), POSE.T_m_k)))
    a.put(CachedKeyframe(KeyframeId(0), SubmapId(3), POSE.T_m_k))
    assert not a.arrived(Key(CachedKeyframe.KIND, 0)), "a newer version is not there yet"


@pytest.mark.parametrize("lost_after", range(20, 60, 3))
def test_three_packets_lost_in_a_row_leave_no_gap_of_a_second_between_poses(lost_after: int) -> None:
    a, b = coded_channel(1, 1000, "radio"), coded_channel(1, 500, "radio")
    cross(a, b)
    rng = np.random.default_rng(0)
    arrived_ns: list[int] = []
    sent = 0
    for tick in range(20, 420):  # frames at 20 Hz, and more corrections than the link carries
        now_ns = tick * 50_000_000
        a.put(LivePose(AgentId(0), now_ns, KeyframeId(7), se3.exp(rng.normal(size=6)), 50))
        for k in range(4):
            a.put(KeyframePose(KeyframeId(100 * tick + k), POSE.T_m_k))
        for packet in a.poll(now_ns):
            sent += 1
            if not lost_after < sent <= lost_after + 3:
                arrived_ns += [now_ns for r in b.receive([packet], now_ns) if isinstance(r, LivePose)]
        a.receive(b.poll(now_ns), now_ns)
    gaps = np.diff(arrived_ns) / 1e9
    assert sent > lost_after + 20
    assert 0.5 < gaps.max() <= 0.95


def test_what_a_base_that_lost_its_map_wrote_ends_once_the_next_one_has_placed_a_submap() -> None:
    """Its tiles and placements lie in another world. One with the same map loses nothing for good."""
    rng, agent = np.random.default_rng(0), coded_channel(agent_session(1, 0))
    tiles = [GridTile(n, 0, 0, 0.1, rng.integers(0, 8, (64, 64)).astype(np.int8)) for n in range(3)]
    other_world = SubmapPlacement(SubmapId(0), se3.exp(np.array([9.0, 0.0, 0.0, 0.0, 0.0, 1.0])))
    keys = [messages.key(tile) for tile in tiles]
    now_ns, held = 0, set[Key]()

    def run(base: CodedChannel, *records: Record) -> None:
        nonlocal now_ns
        for record in records:
            base.put(record)
        for _ in range(60):
            now_ns += 50_000_000
            held.update(messages.key(record) for record in agent.receive(base.poll(now_ns), now_ns))
            held.difference_update(agent.take_removed())
            base.receive(agent.poll(now_ns), now_ns)

    placed = messages.key(other_world)
    run(coded_channel(1, peer=AgentId(0)), SubmapPlacement(SubmapId(0), np.eye(4)), POSE, *tiles)
    assert held == {placed, messages.key(POSE), *keys}
    second = coded_channel(2, peer=AgentId(0))
    run(second)
    assert held == {placed, messages.key(POSE), *keys}, "where things are is not known better yet"
    run(second, other_world, tiles[2])
    assert held == {placed, keys[2]}
    run(second, *tiles)  # by reference to what the agent still holds
    assert held == {placed, *keys} and not agent.undecodable and agent.stats.rejected == 0


@pytest.mark.parametrize("coded", [False, True])
def test_what_is_removed_and_put_again_between_two_looks_is_not_removed(coded: bool) -> None:
    """Who looks applies removals last: a map that lost its place and was merged again at once had none for good."""
    placement = SubmapPlacement(SubmapId(0), np.eye(4))
    key = messages.key(placement)
    base, agent = (coded_channel(1, peer=AgentId(0)), coded_channel(agent_session(1, 0))) if coded else plain_pair()
    cross(base, agent)
    base.put(placement)
    assert len(cross(base, agent)[0]) == 1
    base.remove(key)
    packets = base.poll(10**9)
    base.put(replace(placement, recognised=True))
    records = agent.receive([*packets, *base.poll(10**9 + 1)], 10**9 + 2)
    assert [(r.KIND, getattr(r, "recognised", None)) for r in records][-1] == (SubmapPlacement.KIND, True)
    assert agent.take_removed() == []
    base.remove(key)
    agent.receive(base.poll(10**9 + 3), 10**9 + 4)
    assert agent.take_removed() == [key]


def test_a_new_start_of_an_agent_gets_nothing_of_keyframes_that_earlier_ones_made() -> None:
    """It holds none of them. The base keeps what it said of them, for its store."""
    base = coded_channel(1, peer=AgentId(3))
    poses = [KeyframePose(keyframe_id(submap_id(3, boot, 0), 5), POSE.T_m_k) for boot in (1, 2)]
    first, second = (coded_channel(agent_session(order, order)) for order in (1, 2))
    cross(first, base)
    base.put(poses[0])
    assert [r.KIND for r in cross(base, first)[0]] == [KeyframePose.KIND]
    cross(second, base)
    for pose in poses:
        base.put(replace(pose, T_m_k=np.eye(4)))
    heard, _ = cross(base, second, 20)
    assert [r.keyframe for r in heard if isinstance(r, KeyframePose)] == [poses[1].keyframe]
    key = messages.key(poses[0])
    assert base.arrived(key) and base.own_value(key) == base.own_values()[key]
    assert base.own_value(key) == messages.encode(replace(poses[0], T_m_k=np.eye(4)))
    assert base.endpoint.quiet
    base.remove(key)
    assert base.own_value(key) is None and base.endpoint.quiet


def test_what_a_base_says_last_counts_when_boots_look_alike() -> None:
    """A session tells six bits of the boot: after 64 starts keyframes of an early one look as of the present one, and
    the store of the base kept what it had said of them in between.
    """
    base = coded_channel(1, peer=AgentId(3))
    pose = KeyframePose(keyframe_id(submap_id(3, 1, 0), 5), POSE.T_m_k)
    cross(coded_channel(agent_session(2, 2)), base)
    base.put(pose)
    cross(coded_channel(agent_session(65, 65)), base)
    newer = base.put(replace(pose, T_m_k=np.eye(4)))
    key = messages.key(pose)
    assert base.own_value(key) == base.own_values()[key] == messages.encode(newer)

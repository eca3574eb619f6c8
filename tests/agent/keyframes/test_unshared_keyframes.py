"""Keyframes for the tracker alone: a link that carries few keyframes does not thin out the agent's own map."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.run import FlyingAgent
from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import KeyframeHeader, LivePose, NewLandmarks, Observations, Record
from kiteline_core.ids import KEYPOINT_BITS, NO_KEYFRAME

FRAMES = 60
GAP_NS = 2_000_000_000


class ThinLink(NoBaseChannel):
    """A link that carries a keyframe now and then."""

    def __init__(self, gap_ns: int) -> None:
        super().__init__()
        self.gap_ns = gap_ns
        self.records: list[Record] = []

    def keyframe_gap_ns(self) -> int:
        return self.gap_ns

    def put(self, record: Record) -> Record:
        self.records.append(record)
        return super().put(record)

    def headers(self) -> list[KeyframeHeader]:
        return [r for r in self.records if isinstance(r, KeyframeHeader)]


@pytest.fixture(scope="module")
def room(data_dir: Path) -> Recording:
    return load(str(data_dir / "room_flight.mcap"), frames=FRAMES).without_imu()


def fly(room: Recording, gap_ns: int) -> tuple[FlyingAgent, ThinLink]:
    channel = ThinLink(gap_ns)
    agent = FlyingAgent(room.rig, room.imu, channel=channel)
    for item in room.items:
        agent.step(item)
    return agent, channel


def test_a_thin_link_does_not_thin_out_the_local_map(room: Recording) -> None:
    wide, thin = fly(room, 0), fly(room, GAP_NS)
    in_map = [int(np.count_nonzero(agent.box.map.keyframe != NO_KEYFRAME)) for agent, _ in (wide, thin)]
    assert in_map[1] >= in_map[0] - 1  # as many keyframes to track by
    assert len(wide[1].headers()) == in_map[0]
    assert len(thin[1].headers()) < 0.7 * in_map[1]
    assert thin[0].run.lost == 0


def test_a_frame_that_the_map_cache_finds_hangs_on_a_keyframe_that_the_base_knows(
    room: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, link = fly(room, GAP_NS)
    flown: Any = agent.box
    shared, stored = [header.keyframe for header in link.headers()], flown.map.keyframe
    assert stored.max() > max(shared)  # one that is not shared has the highest id
    matches = SimpleNamespace(T_c_m=np.eye(4), corner=np.arange(30), depth_m=np.ones(30))
    looked: list[set[int]] = []

    def find(seen: object, submaps: set[int], number: int) -> tuple[int, SimpleNamespace]:
        looked.append(submaps)
        return int(flown.map.active), matches

    relocaliser: Any = flown._relocaliser
    monkeypatch.setattr(relocaliser, "_is_consistent", lambda *_: True)
    monkeypatch.setattr(relocaliser._cache, "find", find)
    found = relocaliser._search_cache(SimpleNamespace(number=FRAMES), None, None)
    assert found.keyframe == max(shared)
    stored[np.isin(stored, shared)] = NO_KEYFRAME
    monkeypatch.setattr(relocaliser._cache, "find", lambda seen, submaps, number: looked.append(submaps))
    assert relocaliser._search_cache(SimpleNamespace(number=FRAMES), None, None) is None
    assert looked == [{int(flown.map.active)}, set()]  # nothing is left that the base knows


@pytest.mark.parametrize(("profile", "bytes_s"), [("wifi", 0), ("radio", 1000)])
def test_a_link_does_not_change_how_the_agent_tracks(room: Recording, profile: str, bytes_s: int) -> None:
    """Whatever is rounded and left out on the way to a base: while that has nothing to say, poses are the same."""
    alone, _ = fly(room, 0)
    near, far = coded_channel(1, bytes_s, profile), coded_channel(1, bytes_s, profile)
    linked = FlyingAgent(room.rig, room.imu, channel=near)
    down: list[bytes] = []
    for item in room.items:
        now_ns = item.frame.t_ns - room.items[0].frame.t_ns
        up = linked.step(item, down, now_ns)
        far.receive(up, now_ns)
        down = far.poll(now_ns)
    assert near.stats.packets_sent > 10
    for a, b in zip(alone.run.found, linked.run.found, strict=True):
        assert np.array_equal(a.T_o_b, b.T_o_b)
        assert np.array_equal(a.cov_o, b.cov_o)


def test_the_base_hears_of_shared_keyframes_alone(room: Recording) -> None:
    agent, channel = fly(room, GAP_NS)
    shared: set[int] = set()
    for record in channel.records:
        if isinstance(record, KeyframeHeader):
            assert record.parent == NO_KEYFRAME or record.parent in shared
            shared.add(int(record.keyframe))
        elif isinstance(record, NewLandmarks):
            assert int(record.keyframe) in shared
        elif isinstance(record, Observations):
            assert {int(point) >> KEYPOINT_BITS for point in record.point} <= shared
        elif isinstance(record, LivePose):
            assert int(record.keyframe) in shared
    assert {KeyframeHeader, NewLandmarks, Observations, LivePose} <= {type(record) for record in channel.records}
    assert sorted(k & 0xFFFFF for k in shared) == list(range(len(shared)))  # their numbers have no gaps
    assert {int(e.keyframe) for e in agent.run.found} <= shared
    assert any("not shared" in event for events in agent.run.events for event in events)


def test_an_unshared_keyframe_moves_with_its_parent(room: Recording) -> None:
    agent, _ = fly(room, GAP_NS)
    held = agent.box.map
    unshared = [s for s in np.flatnonzero(held.keyframe != NO_KEYFRAME).tolist() if not held.shared[s]]
    assert unshared
    slot = unshared[-1]
    parent = held.slot_of(int(held.parent[slot]))
    assert held.shared[parent] > 0
    relative = np.linalg.inv(held.T_m_k[parent]) @ held.T_m_k[slot]
    held.T_m_k[parent][:3, 3] += [0.1, 0.0, -0.2]
    held.from_base[parent] = True
    held.compose_unplaced()
    assert np.allclose(held.T_m_k[parent] @ relative, held.T_m_k[slot], atol=1e-9)

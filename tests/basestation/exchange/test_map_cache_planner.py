"""Map cache planner: keyframes near the agent that it lacks, from agents that share with it, at their current poses."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig, MapCachePlannerConfig
from kiteline_basestation.exchange.map_cache_planner import MapCachePlanner
from kiteline_basestation.intake.intake import Intake
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.station import Station
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_codec.channel import CodedChannel, plain_pair
from kiteline_codec.pacing.profiles import RADIO
from kiteline_codec.schema import (
    CachedKeyframe,
    CachedLandmarks,
    CameraIntrinsics,
    Key,
    LivePose,
    Record,
    SubmapPlacement,
    messages,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId, KeyframeId, agent_of_keyframe, keyframe_id, submap_id, submap_of_keyframe

MakeFlight = Callable[..., Any]
SECOND_NS = 1_000_000_000


class Base:
    """A map of some flights, with a map cache planner for the first one's agent."""

    def __init__(self, *flights: Any, share: str = "all", **options: Any) -> None:
        self.map = SparseMap()
        intake = Intake(BaseConfig().intake, self.map)
        for flight in flights:
            intake.take(flight.agent, (CameraIntrinsics(flight.agent, flight.camera), *flight.all_records()), 0)
        self.agent = flights[0].agent
        config = replace(MapCachePlannerConfig(), **options)
        self.map_cache_planner = MapCachePlanner(config, replace(BaseConfig().loops, share=share), self.map)
        self.here, self.there = plain_pair()
        self.received: list[Record] = []
        self.removed: list[Key] = []
        self.now_ns = 0

    def plan(self, keyframe: KeyframeId, turns: int = 1) -> list[KeyframeId]:
        """So many looks while the agent is at a keyframe; what it then holds."""
        for _ in range(turns):
            self.now_ns += SECOND_NS
            live = LivePose(self.agent, self.now_ns, keyframe, np.eye(4), 100)
            self.map_cache_planner.update(self.agent, live, self.here, self.now_ns)
            self.received += self.there.receive((), 0)
            self.removed += self.there.take_removed()
        return self.map_cache_planner.cached(self.agent)


def test_own_keyframes_are_sent_where_they_are_in_view_again(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=80, turns=1.25, points=1500)
    base = Base(flight, local_keyframes=20)
    cached = base.plan(flight.keyframes[-1], turns=6)
    assert cached
    numbers = [flight.keyframes.index(k) for k in cached]
    assert max(numbers) < 60, "the agent remembers the newest twenty itself"
    there = [n for n in numbers if 4 <= n <= 24]  # a whole turn before the last keyframe is number 15
    assert len(there) > 0.7 * len(numbers)
    copies = {r.keyframe: r for r in base.received if isinstance(r, CachedKeyframe)}
    assert set(copies) == set(cached)
    for keyframe, copy in copies.items():
        assert copy.submap == submap_of_keyframe(keyframe)
        assert np.allclose(copy.T_m_k, base.map.pose(keyframe))


def test_landmarks_are_sent_as_the_agents_camera_would_see_them(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=60, turns=1.2, points=1500)
    base = Base(flight, local_keyframes=10)
    camera = replace(flight.camera, fx=300.0, fy=310.0, cx=300.0, cy=200.0)
    base.map.cameras[flight.agent] = camera  # the reader has got another camera since
    base.plan(flight.keyframes[-1])
    parts = [r for r in base.received if isinstance(r, CachedLandmarks)]
    assert parts
    for part in parts:
        points = base.map.slots_of(part.keyframe)[part.index]
        xyz, known = base.map.positions(points)
        assert known.all()
        T = base.map.world_pose(part.keyframe)
        local = se3.transform(se3.inverse(T), xyz)
        assert np.allclose(part.inv_depth, 1.0 / local[:, 2], rtol=1e-5)
        uv = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        assert np.allclose(part.uv, uv, atol=0.01)


def test_the_number_is_bounded_and_the_farthest_are_removed(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=80, turns=1.0, points=1500)
    base = Base(flight, max_keyframes=5, local_keyframes=1)
    first = base.plan(flight.keyframes[10], turns=4)
    assert len(first) == 5
    second = base.plan(flight.keyframes[50], turns=4)  # the other side of the room
    assert len(second) == 5
    assert not set(first) & set(second)
    back = {key.id for key in base.removed}
    assert back == set(first)


@pytest.mark.parametrize(("share", "expected"), [("all", True), ("0 1", True), ("none", False), ("1 2", False)])
def test_only_agents_that_share_send_keyframes(make_flight: MakeFlight, share: str, expected: bool) -> None:
    mine = make_flight(keyframes=12, turns=0.2, points=1500)
    theirs = make_flight(keyframes=12, turns=0.2, agent=1, variant=1, points=1500)
    base = Base(mine, theirs, share=share)
    a, b = (submap_of_keyframe(f.keyframes[0]) for f in (mine, theirs))
    assert not base.plan(mine.keyframes[-1]), "two maps, of which nobody knows how they lie"
    base.map.root_submaps[b] = a
    cached = base.plan(mine.keyframes[-1])
    assert bool(cached) == expected
    assert all(agent_of_keyframe(k) == 1 for k in cached)


def test_a_cached_keyframe_moves_with_the_map_and_is_removed_with_it(make_flight: MakeFlight) -> None:
    mine = make_flight(keyframes=12, turns=0.2, points=1500)
    theirs = make_flight(keyframes=12, turns=0.2, agent=1, variant=1, points=1500)
    base = Base(mine, theirs)
    a, b = (submap_of_keyframe(f.keyframes[0]) for f in (mine, theirs))
    base.map.root_submaps[b] = a
    cached = base.plan(mine.keyframes[-1], turns=2)
    base.received.clear()
    base.plan(mine.keyframes[-1])
    assert not base.received, "nothing moved"
    base.map.move_submap(b, se3.exp(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0])))
    base.plan(mine.keyframes[-1])
    moved = {r.keyframe for r in base.received if isinstance(r, CachedKeyframe)}
    assert moved == set(cached)
    assert not any(isinstance(r, CachedLandmarks) and r.keyframe in cached for r in base.received)
    del base.map.root_submaps[b]  # the merge is taken back
    assert not base.plan(mine.keyframes[-1])
    assert {key.id for key in base.removed} == set(cached)


def test_a_thin_link_carries_the_best_landmarks_of_few_keyframes(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=60, turns=1.2, points=1500)
    base = Base(flight, local_keyframes=10)
    base.here.profile = RADIO  # type: ignore[misc]
    base.plan(flight.keyframes[-1])
    for keyframe in base.map_cache_planner.cached(flight.agent):
        parts = [r for r in base.received if isinstance(r, CachedLandmarks) and r.keyframe == keyframe]
        assert 0 < sum(len(p.index) for p in parts) <= RADIO.cached_landmarks
    assert len(base.map_cache_planner.cached(flight.agent)) == 1
    base.here.arrived = lambda key: False  # type: ignore[method-assign]
    first = base.map_cache_planner.cached(flight.agent)
    assert base.plan(flight.keyframes[-1], turns=3) == first, "one is on its way"
    later = base.plan(flight.keyframes[35], turns=2)  # the other side of the room
    assert not set(later) & set(first), "what is no longer wanted is not sent"
    assert len(later) <= 1


def test_what_is_sent_depends_on_how_far_motion_is_predicted(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=60, turns=1.2, points=1500)
    sent = []
    for horizon_s in (0.1, 10.0):
        base = Base(flight, local_keyframes=1, max_keyframes=3, horizon_s=horizon_s)
        for n in range(20, 40):
            base.plan(flight.keyframes[n])
        sent.append([flight.keyframes.index(r.keyframe) for r in base.received if isinstance(r, CachedKeyframe)])
    assert sent[0] != sent[1]


def test_a_new_base_process_does_not_keep_the_cache_of_the_last_one(make_flight: MakeFlight) -> None:
    flight = make_flight(keyframes=60, turns=1.2, points=1500)
    base = Base(flight, local_keyframes=10)
    base.plan(flight.keyframes[-1])
    cached = [r for r in base.received if isinstance(r, CachedKeyframe | CachedLandmarks)]
    assert cached
    submap = submap_of_keyframe(flight.keyframes[0])
    own = {messages.key(r): messages.encode(r) for r in [SubmapPlacement(submap, np.eye(4)), *cached]}
    station = Station(BaseConfig(), lambda agent: CodedChannel(SyncConfig(), 2))
    received = {messages.key(r): messages.encode(r) for r in flight.records[0]}
    restore(station, SavedMap({flight.agent: SavedValues(received, own)}), 0)
    channel = station.channels[flight.agent]
    assert isinstance(channel, CodedChannel)
    assert list(channel.endpoint.own_values()) == [messages.key(SubmapPlacement(submap, np.eye(4)))]


def test_an_agent_that_starts_again_is_heard_whatever_its_clock_says() -> None:
    intake = Intake(BaseConfig().intake, SparseMap())
    agent = AgentId(2)
    old, new = (keyframe_id(submap_id(agent, boot, 0), 0) for boot in (5, 4))  # numbers of starts may be drawn
    for keyframe, t_ns in ((old, 900), (old, 800), (new, 5), (new, 4)):
        intake.take(agent, (LivePose(agent, t_ns, keyframe, np.eye(4), 80),), 0)
    assert (intake.live[agent].keyframe, intake.live[agent].t_ns) == (new, 5)

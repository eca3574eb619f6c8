"""The station over real channels: both sides end with the same values."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.station import Station
from kiteline_codec.channel import CodedChannel, RecordChannel, coded_channel, plain_pair
from kiteline_codec.schema import (
    CameraIntrinsics,
    Key,
    KeyframePose,
    Observations,
    Record,
    RefinedLandmarks,
    ScanImages,
)
from kiteline_codec.schema.owners import KEYFRAME_BYTES
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.ids import AgentId, keyframe_id, submap_id

STEP_NS = 100_000_000


def fly(station: Station, agent_end: RecordChannel, flight: Any) -> list[Record]:
    heard: list[Record] = []
    agent_end.put(CameraIntrinsics(flight.agent, flight.camera))
    done: list[Any] = []
    packets: tuple[bytes, ...] = ()
    for n in range(len(flight.records) + 30):
        now_ns = n * STEP_NS
        heard += agent_end.receive(packets, now_ns)
        for record in flight.records[n] if n < len(flight.records) else ():
            agent_end.put(record)
        output = station.step({flight.agent: agent_end.poll(now_ns)}, done, now_ns)
        done = [run_job(job) for job in output.jobs]
        packets = dict(output.packets)[flight.agent]
    return heard


def test_the_agent_holds_what_the_base_computes_with(make_flight: Callable[..., Any]) -> None:
    flight = make_flight(keyframes=12, turns=0.4)
    base_end, agent_end = CodedChannel(SyncConfig(), 1), CodedChannel(SyncConfig(), 1)
    station = Station(BaseConfig(), lambda agent: base_end)
    heard = fly(station, agent_end, flight)
    sparse_map = station.mapper.map
    poses = {r.keyframe: r for r in heard if isinstance(r, KeyframePose)}
    depths = {r.keyframe: r for r in heard if isinstance(r, RefinedLandmarks)}
    assert len(poses) == 11
    assert len(depths) > 5
    for keyframe, pose in poses.items():
        held = sparse_map.pose(keyframe)
        assert held is not None
        assert np.array_equal(held, pose.T_m_k)
    for keyframe, record in depths.items():
        new_landmarks = sparse_map.slots_of(keyframe)[record.index]
        assert np.array_equal(sparse_map.keypoints.refined[new_landmarks], record.inv_depth)
        assert np.array_equal(sparse_map.keypoints.offset[new_landmarks], record.offset)
    assert base_end.endpoint.digest_equal
    assert station.mapper.idle


def test_nothing_is_planned_for_an_agent_that_has_left(
    make_flight: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Plans take milliseconds a second of each agent, and a base keeps its agents for days."""
    flight = make_flight(keyframes=4, turns=0.1)
    base_end, agent_end = plain_pair()
    station = Station(BaseConfig(), lambda agent: base_end)
    fly(station, agent_end, flight)
    planned: list[int] = []
    for planner in (station.tile_planner, station.map_cache_planner):
        monkeypatch.setattr(planner, "update", lambda agent, live, channel, now_ns: planned.append(now_ns))
    for second in range(60):
        station.step({}, (), (4 + second) * 10**9)
    assert 0 < len(planned) <= 2 * BaseConfig().publish.batch_wait_s
    agent_end.put(CameraIntrinsics(flight.agent, flight.camera))
    station.step({flight.agent: agent_end.poll(70 * 10**9)}, (), 70 * 10**9)
    assert planned[-1] == 70 * 10**9


def test_keys_that_an_agent_removed_are_not_kept() -> None:
    """An agent removes each of its images once it has arrived; over a day of flights the keys took up memory."""
    agent, keyframe = AgentId(0), keyframe_id(submap_id(0, 1, 0), 0)
    base_end, agent_end = coded_channel(1, peer=agent), coded_channel(65)
    station = Station(BaseConfig(), lambda agent: base_end)
    images = Key(ScanImages.KIND, keyframe, 0)
    agent_end.put(ScanImages(keyframe, np.eye(4), 0, np.array([0.0, -1.0, 0.0]), b"image"))
    packets: tuple[bytes, ...] = ()
    for n in range(20):
        agent_end.receive(packets, n * STEP_NS)
        if n == 10:
            assert base_end.endpoint.peer_value(images) is not None
            agent_end.remove(images)
        packets = dict(station.step({agent: agent_end.poll(n * STEP_NS)}, (), n * STEP_NS).packets)[agent]
    assert base_end.endpoint.peer_value(images) is None
    assert base_end.take_removed() == []


def test_plain_channels_and_order_of_agents(make_flight: Callable[..., Any]) -> None:
    ends = {agent: plain_pair() for agent in (AgentId(0), AgentId(2))}
    station = Station(BaseConfig(), lambda agent: ends[agent][0])
    flights = [make_flight(keyframes=5, turns=0.1, agent=int(a), seed=int(a)) for a in (2, 0)]
    for flight in flights:
        fly(station, ends[flight.agent][1], flight)
    output = station.step({}, (), 10**10)
    assert [agent for agent, _ in output.packets] == [0, 2]
    assert len(station.mapper.map.submaps) == 2
    assert len(station.mapper.placements) == 1  # where the second agent began is not known


def test_keyframes_that_agree_with_older_ones_earn_their_agent_memory(make_flight: Callable[..., Any]) -> None:
    flight = make_flight(keyframes=12, turns=0.4)
    base_end = coded_channel(1, peer=flight.agent)
    station = Station(BaseConfig(), lambda agent: base_end)
    fly(station, CodedChannel(SyncConfig(), 1), flight)
    assert base_end.endpoint.received.claims.earned >= 11 * KEYFRAME_BYTES  # all but the first


def test_keyframes_that_are_made_up_earn_nothing(make_flight: Callable[..., Any]) -> None:
    flight, draw = make_flight(keyframes=12, turns=0.4), np.random.default_rng(1)
    for records in flight.records:
        for i, record in enumerate(records):
            if isinstance(record, Observations):
                records[i] = replace(record, uv=draw.uniform(0.0, 470.0, record.uv.shape).astype(np.float32))
    base_end = coded_channel(1, peer=flight.agent)
    station = Station(BaseConfig(), lambda agent: base_end)
    fly(station, CodedChannel(SyncConfig(), 1), flight)
    assert station.mapper.counts.keyframes == 12
    assert base_end.endpoint.received.claims.earned <= KEYFRAME_BYTES


def test_a_base_that_meets_an_agent_late_takes_all_it_has(make_flight: Callable[..., Any]) -> None:
    """The newest keyframes come first, and claim all memory that a stranger may; none is of use without the first."""
    flight = make_flight(keyframes=40, turns=1.0)
    agent_end, base_end = CodedChannel(SyncConfig(), 1), coded_channel(1, peer=flight.agent)
    claimed = sum(record.keypoints for records in flight.records for record in records[:1]) * 120
    config = replace(base_end.endpoint.config, unused_inbox_bytes=claimed // 2)
    object.__setattr__(base_end.endpoint, "config", config)
    for records in flight.records:
        for record in records:
            agent_end.put(record)
    late = replace(flight, records=[[] for _ in range(120)])
    station = Station(BaseConfig(), lambda agent: base_end)
    fly(station, agent_end, late)
    assert len(station.mapper.map) == 40
    assert all(station.mapper.map.is_complete(k) for k in flight.keyframes)
    assert station.mapper.counts.keyframes >= 40 and agent_end.endpoint.quiet

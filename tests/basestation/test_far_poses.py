"""Motions of one agent that fit their codes, but whose sum does not, are left out; the base and other agents go on."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.station import Station
from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import (
    CameraIntrinsics,
    GravityAlignment,
    KeyframeHeader,
    LivePose,
    Record,
    SubmapScale,
    SubmapTie,
)
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id

MakeFlight = Callable[..., Any]

FAULTY, GOOD = AgentId(0), AgentId(1)
FIRST, SECOND = submap_id(0, 1, 0), submap_id(0, 1, 1)
BEGIN, NEXT = keyframe_id(FIRST, 0), keyframe_id(SECOND, 0)
NS = 10**9


def along_x(metres: float) -> F64:
    return se3.from_rt(np.eye(3), np.array([metres, 0.0, 0.0]))


FAR = along_x(1e8)
AT_ORIGIN = [KeyframeHeader(BEGIN, NS, NO_KEYFRAME, np.eye(4), 0)]
FAR_OFF = [KeyframeHeader(BEGIN, NS, NO_KEYFRAME, FAR, 0)]
NEXT_SUBMAP = [KeyframeHeader(NEXT, 2 * NS, NO_KEYFRAME, np.eye(4), 0)]
NEXT_IS_FAR = [KeyframeHeader(NEXT, 2 * NS, NO_KEYFRAME, along_x(-1e8), 0)]


@pytest.mark.parametrize(
    "records",
    [
        [*FAR_OFF, LivePose(FAULTY, NS, BEGIN, FAR, 90), *NEXT_SUBMAP],
        [*AT_ORIGIN, LivePose(FAULTY, NS, BEGIN, FAR, 90), *NEXT_IS_FAR],
        [*AT_ORIGIN, GravityAlignment(FIRST, FAR), LivePose(FAULTY, NS, BEGIN, FAR, 90), *NEXT_SUBMAP],
        [*FAR_OFF, *NEXT_SUBMAP, SubmapTie(SECOND, BEGIN, FAR, 0.1, 0.01)],
        [*AT_ORIGIN, LivePose(FAULTY, NS, BEGIN, along_x(9e6), 90), *NEXT_SUBMAP, SubmapScale(FIRST, 2.0**20)],
    ],
    ids=["live pose", "next submap", "gravity", "tie", "scale"],
)
def test_motions_that_add_up_to_no_code_are_refused(make_flight: MakeFlight, records: list[Record]) -> None:
    flight = make_flight(keyframes=6, turns=0.1, agent=int(GOOD))
    station = Station(BaseConfig(), lambda agent: coded_channel(1, peer=agent))
    ends = {agent: coded_channel(65) for agent in (FAULTY, GOOD)}
    camera = RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.11, stereo=False, T_b_c=np.eye(4))
    for record in (CameraIntrinsics(FAULTY, camera), *records):
        ends[FAULTY].put(record)
    for record in flight.all_records():
        ends[GOOD].put(record)
    packets: dict[AgentId, tuple[bytes, ...]] = {}
    done: list[JobDone] = []
    for n in range(70):
        now_ns = n * 50_000_000
        for agent, end in ends.items():
            end.receive(packets.get(agent, ()), now_ns)
        output = station.step({agent: end.poll(now_ns) for agent, end in ends.items()}, done, now_ns)
        packets, done = dict(output.packets), [run_job(job) for job in output.jobs]
    summary: Any = station.mapper.summary()
    assert summary["refused_records"] > 0
    assert all(station.mapper.map.pose(keyframe) is not None for keyframe in flight.keyframes)
    assert summary["bundles"] > 0


def test_keyframes_whose_chain_leads_too_far_have_no_pose() -> None:
    sparse_map, (first, second, third) = SparseMap(), (keyframe_id(FIRST, n) for n in range(3))
    sparse_map.add_keyframe(third, 3, second, np.eye(4), 0)
    sparse_map.add_keyframe(second, 2, first, along_x(6e6), 0)
    sparse_map.add_keyframe(first, 1, NO_KEYFRAME, along_x(6e6), 0)
    assert sparse_map.pose(first) is not None and sparse_map.pose(second) is None and sparse_map.pose(third) is None
    assert sparse_map.far_poses == 1
    sparse_map.set_pose(first, along_x(1.0))
    assert sparse_map.pose(third) is not None  # now they are near
    sparse_map.set_pose(third, np.eye(4))
    sparse_map.set_world_poses([first, third], np.array([along_x(2.0), along_x(np.inf)]))
    poses = [sparse_map.pose(keyframe) for keyframe in (first, third)]
    assert [pose[0, 3] for pose in poses if pose is not None] == [2.0, 0.0]

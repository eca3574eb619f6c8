"""Stations whose maps are saved, and agents that fly for them."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.station import Station
from kiteline_basestation.store.keeper import snapshot
from kiteline_basestation.store.saved_map import SavedMap
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import (
    CameraIntrinsics,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.geometry import se3
from kiteline_core.ids import (
    AgentId,
)
from tests.basestation.feeding import WITHOUT_GRID

STEP_NS = 100_000_000


ELSEWHERE = se3.exp(np.array([0.5, -0.3, 0.2, 0.1, 0.4, -1.1]))


MakeFlight = Callable[..., Any]


def new_station(words: Any, session: int = 1, config: BaseConfig = WITHOUT_GRID) -> Station:
    return Station(config, lambda agent: CodedChannel(SyncConfig(), session), words)


class Agents:
    """Agents that say what they see, a keyframe a step, over channels without loss."""

    def __init__(self, flights: list[Any]) -> None:
        self.flights = flights
        self.ends = {f.agent: CodedChannel(SyncConfig(), 1) for f in flights}
        for flight in flights:
            self.ends[flight.agent].put(CameraIntrinsics(flight.agent, flight.camera))
        self.now_ns = 0
        self.done: list[JobDone] = []
        self.down: Mapping[AgentId, tuple[bytes, ...]] = {}

    def fly(self, station: Station, begin: int, end: int, each: Callable[[], None] = lambda: None) -> None:
        """Keyframes begin..end of every flight; beyond the last one time passes."""
        for n in range(begin, end):
            self.now_ns += STEP_NS
            up = {}
            for flight in self.flights:
                channel = self.ends[flight.agent]
                channel.receive(self.down.get(flight.agent, ()), self.now_ns)
                for record in flight.records[n] if n < len(flight.records) else ():
                    channel.put(record)
                up[flight.agent] = channel.poll(self.now_ns)
            output = station.step(up, self.done, self.now_ns)
            self.done = [run_job(job) for job in output.jobs]
            self.down = dict(output.packets)
            each()

    def base_died(self) -> None:
        self.done, self.down = [], {}


def whole(station: Station) -> dict[str, Any]:
    """The map, told in a way that does not depend on the order of arrival."""
    sparse_map = station.mapper.map
    table, out = sparse_map.keypoints, {}
    for keyframe in sorted(sparse_map.rows):
        slots = sparse_map.slots_of(keyframe)
        roots = table.root[slots]
        points = np.where(roots >= 0, sparse_map.landmark_ids(np.maximum(roots, 0)), -1)
        refined = table.flags[slots] & 4 != 0
        alive = refined & (roots == slots) & (table.flags[slots] & 2 == 0)
        pose, world = sparse_map.pose(keyframe), sparse_map.world_pose(keyframe)
        out[str(keyframe)] = (
            pose.tobytes(), world.tobytes(), points.tolist(), (table.flags[slots] & 3).tolist(),
            table.refined[slots[alive]].tobytes(), table.offset[slots[alive]].tobytes(),
            int(sparse_map.keyframes.culled[sparse_map.rows[keyframe]]),
        )  # fmt: skip
    out["placements"] = [(int(s), T.tobytes()) for s, T in station.mapper.placements.items()]
    out["roots"] = sorted(sparse_map.root_submaps.items())
    out["offsets"] = sorted((int(a), offset.tolist()) for a, offset in sparse_map.disparity_offset_px.items())
    out["loops and merges"] = {
        n: t for n, t in snapshot(station, SavedMap()).texts.items() if ".edges/" in n or ".merges/" in n
    }
    return out

"""From the station to the snapshot that the status page shows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid import empty
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.station import Station
from kiteline_basestation.web.page_snapshot import AgentView, Snapshot
from kiteline_codec.channel import CodedChannel
from kiteline_core.ids import KEYPOINT_BITS, SEQUENCE_BITS, AgentId, SubmapId, agent_of_submap

F64 = NDArray[np.float64]


def nothing(now_ns: int) -> Snapshot:
    """A base that has just started."""
    grid = empty(GridConfig())
    return Snapshot(now_ns, now_ns, (), grid.points, grid.labels, None, 0)


def overview(station: Station, now_ns: int, started_ns: int) -> Snapshot:
    """The station as it stands. Points and labels are those of the newest grid. now_ns: as handed to its steps."""
    mapper = station.mapper
    summary: dict[str, Any] = mapper.summary()
    born = _points_of_agents(mapper)
    agents = []
    for number, told in summary["agents"].items():
        agent = AgentId(number)
        channel = station.channels.get(agent)
        stats = channel.stats if isinstance(channel, CodedChannel) else None
        heard_ns, quality, pose = told["last_seen_ns"], told["quality"], told["T_w_c"]
        agents.append(
            AgentView(
                agent,
                heard_ns=-1 if heard_ns is None else heard_ns,
                quality=0 if quality is None else quality,
                T_w_c=None if pose is None else np.array(pose),
                path=_path(mapper, agent),
                keyframes=told["keyframes"],
                points=born.get(agent, 0),
                submaps=told["submaps"],
                bytes_up=stats.bytes_received if stats is not None else 0,
                bytes_down=stats.bytes_sent if stats is not None else 0,
            )
        )
    grid = mapper.grid.map
    return Snapshot(
        now_ns, started_ns, tuple(agents), grid.points, grid.labels, grid,
        map_revision=summary["keyframes"] + summary["bundles"] + summary["grids"],
        loops=summary["loops"], merges=summary["merges"],
    )  # fmt: skip


def _path(mapper: Mapper, agent: AgentId) -> F64:
    """Positions (k,3) in w of an agent's keyframes in placed submaps, in order of id."""
    parts = [np.zeros((0, 3))]
    for submap in sorted(mapper.placements):
        if agent_of_submap(submap) == agent:
            poses = [mapper.map.pose(keyframe) for keyframe in mapper.map.submaps.get(submap, [])]
            known = np.array([pose for pose in poses if pose is not None]).reshape(-1, 4, 4)
            T_w_m = mapper.placements[submap]
            parts.append(known[:, :3, 3] @ T_w_m[:3, :3].T + T_w_m[:3, 3])
    return np.concatenate(parts)


def _points_of_agents(mapper: Mapper) -> dict[AgentId, int]:
    submaps, count = np.unique(
        mapper.map.landmark_ids(mapper.map.live_landmarks()) >> (SEQUENCE_BITS + KEYPOINT_BITS), return_counts=True
    )
    out: dict[AgentId, int] = {}
    for submap, n in zip(submaps.tolist(), count.tolist(), strict=True):
        agent = agent_of_submap(SubmapId(submap))
        out[agent] = out.get(agent, 0) + n
    return out

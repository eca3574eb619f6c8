"""The snapshot of the station that the status page shows."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from kiteline_basestation.grid.grid_view import GridView
from kiteline_basestation.grid.placed_map import some_landmarks
from kiteline_basestation.map.map_tables import NO_POSE
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.station import Station
from kiteline_codec.channel import CodedChannel
from kiteline_core.arrays import F64, U8
from kiteline_core.ids import AgentId, agent_of_submap

POINTS_SHARE = 20  # changes of the map, in parts of its keyframes, after which its points are gathered again
LOOKED_AT = 60_000  # keypoints from which they are gathered: a quarter of them are points, and the page shows 12,000


@dataclass(frozen=True, slots=True)
class AgentStatus:
    """One agent. T_w_c: (4,4) newest camera pose in w, None if not placed.

    path: (k,3) its keyframes in w, by time, m; a row of NaN between two submaps, as nothing says how it flew there.
    quality: -1 tracking failed, 1..100, None unknown. bytes_up, bytes_down: totals on the link.
    own_unit: its map has no scale in metres, so that lengths are in a unit of the map's own.
    """

    agent: AgentId
    last_packet_ns: int | None  # time of the last packet on the clock of PageSnapshot.now_ns; None never
    quality: int | None
    T_w_c: F64 | None
    path: F64
    keyframes: int
    landmarks: int
    submaps: int
    bytes_up: int
    bytes_down: int
    own_unit: bool = False


@dataclass(frozen=True, slots=True)
class PageSnapshot:
    """The base at one instant. points: (m,3) in w, m. labels: (m,) uint8. Arrays are never written again.

    map_revision, layout: one of them changes when points, paths or grid do; layout when maps are placed otherwise, as
    by a merge, or are gone. counts: the numbers of `Mapper.summary`.
    troubles: what is wrong with the process, a line each. own_unit: no map in w has a scale in metres.
    """

    now_ns: int
    started_ns: int
    agents: tuple[AgentStatus, ...]
    points: F64
    labels: U8
    grid: GridView
    map_revision: int
    counts: Mapping[str, int] = field(default_factory=dict)
    troubles: tuple[str, ...] = ()
    own_unit: bool = False
    layout: int = 0


def empty_snapshot(now_ns: int) -> PageSnapshot:
    """A base that has just started."""
    return PageSnapshot(now_ns, now_ns, (), np.zeros((0, 3)), np.zeros(0, np.uint8), GridView(1.0), 0)


def take_numbers(station: Station, now_ns: int, started_ns: int) -> PageSnapshot:
    """The station now, without points and paths. now_ns: on the clock of its steps."""
    mapper = station.mapper
    summary: dict[str, Any] = mapper.summary()
    landmarks = _landmarks_by_agent(mapper)
    agents = []
    for number, state in summary["agents"].items():
        agent = AgentId(number)
        channel = station.channels.get(agent)
        stats = channel.stats if isinstance(channel, CodedChannel) else None
        agents.append(
            AgentStatus(
                agent,
                last_packet_ns=state["last_seen_ns"],
                quality=state["quality"] or None,
                T_w_c=None if state["T_w_c"] is None else np.array(state["T_w_c"]),
                path=np.zeros((0, 3)),
                keyframes=state["keyframes"],
                landmarks=landmarks.get(agent, 0),
                submaps=state["submaps"],
                bytes_up=stats.bytes_received if stats is not None else 0,
                bytes_down=stats.bytes_sent if stats is not None else 0,
                own_unit=_has_own_unit(mapper, agent),
            )
        )
    counts = {name: value for name, value in summary.items() if isinstance(value, int)}
    revision = counts["keyframes"] + counts["bundles"] + counts["grids"]
    empty = empty_snapshot(started_ns)
    layout = hash(tuple((submap, S_w_m.tobytes()) for submap, S_w_m in sorted(mapper.placements.items())))
    placed = {mapper.map.map_id(submap) for submap in mapper.placements}
    return replace(
        empty, now_ns=now_ns, agents=tuple(agents), grid=mapper.views.take(), map_revision=revision, counts=counts,
        own_unit=bool(placed) and all(mapper.map.is_up_to_scale(map_id) for map_id in placed), layout=layout,
    )  # fmt: skip


def take_snapshot(
    station: Station, now_ns: int, started_ns: int, before: PageSnapshot | None = None
) -> PageSnapshot:  # fmt: skip
    """The station now. before: an older one, whose points are taken while the map has hardly grown.

    now_ns: on the clock of its steps.
    """
    mapper = station.mapper
    now = take_numbers(station, now_ns, started_ns)
    now = replace(now, agents=tuple(replace(agent, path=_path(mapper, agent.agent)) for agent in now.agents))
    if before is not None and before.layout == now.layout:
        if 0 <= now.map_revision - before.map_revision < now.counts["keyframes"] // POINTS_SHARE:
            return replace(now, points=before.points, labels=before.labels, map_revision=before.map_revision)
    slots, points = some_landmarks(mapper.map, mapper.placements, LOOKED_AT)
    return replace(now, points=points, labels=mapper.labels(slots))


def _path(mapper: Mapper, agent: AgentId) -> F64:
    """Positions (k,3) in w of an agent's keyframes in placed submaps, in order of id; NaN between two submaps."""
    parts, table = list[F64](), mapper.map.keyframes
    for submap in sorted(mapper.placements):
        if agent_of_submap(submap) == agent:
            rows = mapper.map.rows_of(submap)
            rows = rows[table.pose_source[rows] != NO_POSE]
            S_w_m = mapper.placements[submap]
            parts += [np.full((1, 3), np.nan)] if parts else []
            parts.append(table.T_m_k[rows, :3, 3] @ S_w_m[:3, :3].T + S_w_m[:3, 3])
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def _has_own_unit(mapper: Mapper, agent: AgentId) -> bool:
    """True if the map in which an agent last was has no scale in metres."""
    newest = max((s for s in mapper.map.submaps if agent_of_submap(s) == agent), default=None)
    return newest is not None and mapper.map.is_up_to_scale(mapper.map.map_id(newest))


def _landmarks_by_agent(mapper: Mapper) -> dict[AgentId, int]:
    """Number of root landmarks of each agent."""
    out: dict[AgentId, int] = {}
    for submap, count in mapper.map.live_by_submap().items():
        agent = agent_of_submap(submap)
        out[agent] = out.get(agent, 0) + count
    return out

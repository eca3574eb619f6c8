"""Plans which tiles of the grid each agent holds: those around it and ahead, of the storey on which it flies.

A tile is sent when enough of its cells differ from what the agent has, the most useful first, within a number of bytes
for each of the agent's keyframes. Tiles far away are removed again.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from kiteline_basestation.config import TileConfig
from kiteline_basestation.exchange.agent_velocity import AgentVelocity
from kiteline_basestation.grid.grid_updates import GridUpdates
from kiteline_basestation.grid.scan_kernels import SIDE
from kiteline_basestation.grid.tile_store import Place
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import GridTile, LivePose, messages
from kiteline_core.arrays import F64, I8
from kiteline_core.geometry import sim3
from kiteline_core.ids import AgentId, SubmapId, agent_of_submap, submap_of_keyframe

_KEPT_RATIO = 1.5  # of the option reach_m; tiles farther away are removed
_SOLID_WEIGHT = 4  # cells added for each one that became an obstacle, or is none any more
_PERIOD_S = 1.0  # s between two plans
_NEAR_M = 4.0  # m; added to distances: among near tiles changes decide
_OVERHEAD_BYTES = 14  # bytes of a tile in a packet: its key, version and a share of headers


@dataclass(slots=True)
class _Sent:
    """A tile as the agent has it, or will. revision: of the grid when it was compared last."""

    cells: I8
    revision: int


@dataclass(slots=True)
class _AgentTiles:
    """State of one agent. credit_bytes: what may be sent now."""

    credit_bytes: float
    velocity: AgentVelocity
    due_ns: int = 0  # time of the next plan
    keyframes: int = 0
    sent: dict[Place, _Sent] = field(default_factory=dict)


class TilePlanner:
    """The tiles of all agents. placements: S_w_m (4,4) by submap, kept up to date by its owner."""

    def __init__(
        self, config: TileConfig, sparse_map: SparseMap, grid: GridUpdates, placements: Mapping[SubmapId, F64]
    ) -> None:  # fmt: skip
        self._config = config
        self._map = sparse_map
        self._updates = grid
        self._placements = placements
        self._agents: dict[AgentId, _AgentTiles] = {}

    def sent(self, agent: AgentId) -> list[Place]:
        """The tiles that an agent holds, or will, in order of sending."""
        return list(self._agents[agent].sent) if agent in self._agents else []

    def update(self, agent: AgentId, live: LivePose | None, channel: RecordChannel, now_ns: int) -> None:
        """Plan the tiles of an agent at `live` once a period, and send the changes over its channel."""
        velocity = AgentVelocity(_PERIOD_S)
        state = self._agents.setdefault(agent, _AgentTiles(self._config.most_credit_bytes, velocity))
        if not self._config.max_tiles or live is None or now_ns < state.due_ns or self._updates.behind:
            return
        submap = submap_of_keyframe(live.keyframe)
        S_w_m, T_m_k = self._placements.get(submap), self._map.pose(live.keyframe)
        ground_m = self._updates.ground_below(live.keyframe)
        if S_w_m is None or T_m_k is None or ground_m is None:
            return
        state.due_ns = now_ns + round(_PERIOD_S * 1e9)
        here = sim3.place(S_w_m, T_m_k @ live.T_k_c)[:3, 3]
        ahead = here + self._config.horizon_s * state.velocity.update(live.t_ns, submap, here)
        keyframes = sum(len(k) for s, k in self._map.submaps.items() if agent_of_submap(s) == agent)
        earned = self._config.keyframe_bytes * (keyframes - state.keyframes)
        state.credit_bytes = min(state.credit_bytes + earned, self._config.most_credit_bytes)
        state.keyframes = keyframes
        near = self._near(here, ahead, self._updates.grid.storey_of(ground_m))
        self._remove_far(state, here, ahead, near, channel)
        self._send(state, near, channel)

    def _near(self, here: F64, ahead: F64, storey: int) -> dict[Place, float]:
        """Tiles of a storey within reach, and how far each lies from where the agent is or soon will be."""
        side, reach = SIDE * self._updates.grid.config.cell_m, self._config.reach_m
        touched = self._updates.grid.touched
        out = {}
        for x, y in (here[:2], ahead[:2]):  # a box around both would have no bounds: an agent may jump
            columns = range(math.floor((x - reach) / side), math.floor((x + reach) / side) + 1)
            for row in range(math.floor((y - reach) / side), math.floor((y + reach) / side) + 1):
                for column in columns:
                    place = Place(storey, row, column)
                    if place not in touched or place in out:
                        continue  # most are not
                    distance = self._distance(place, here, ahead)
                    if distance <= reach:
                        out[place] = distance
        return dict(sorted(out.items(), key=lambda item: (item[1], item[0]))[: self._config.max_tiles])

    def _distance(self, place: Place, here: F64, ahead: F64) -> float:
        side = SIDE * self._updates.grid.config.cell_m
        centre = np.array([(place.column + 0.5) * side, (place.row + 0.5) * side])
        return float(min(np.hypot(*(centre - here[:2])), np.hypot(*(centre - ahead[:2]))))

    def _remove_far(
        self, state: _AgentTiles, here: F64, ahead: F64, near: Mapping[Place, float], channel: RecordChannel
    ) -> None:
        """Remove tiles of other storeys, those out of reach, and the farthest if there are too many."""
        storey = {place.storey for place in near}
        far = [
            place
            for place in state.sent
            if (storey and place.storey not in storey)
            or self._distance(place, here, ahead) > _KEPT_RATIO * self._config.reach_m
        ]
        idle = [place for place in state.sent if place not in near and place not in far]
        spare = self._config.max_tiles - len(state.sent) + len(far)
        idle.sort(key=lambda place: -self._distance(place, here, ahead))
        far += idle[: max(0, sum(place not in state.sent for place in near) - spare)]
        for place in far:
            del state.sent[place]
            channel.remove(GridTile.key_of(place.column, place.row, place.storey))

    def _send(self, state: _AgentTiles, near: Mapping[Place, float], channel: RecordChannel) -> None:
        """Send the tiles that changed most and lie nearest, as far as the credit and the link have room."""
        room = channel.profile.cached_ahead - sum(
            not channel.arrived(GridTile.key_of(p.column, p.row, p.storey)) for p in state.sent
        )
        if room <= 0 or state.credit_bytes <= 0.0:
            return
        grid = self._updates.grid
        ranked = []
        for place, distance in near.items():
            held = state.sent.get(place)
            if held is not None and held.revision >= grid.touched[place]:
                continue
            cells, _ = grid.cells(place)
            before = np.full_like(cells, -1) if held is None else held.cells
            other = cells != before
            changes = int(np.count_nonzero(other)) + _SOLID_WEIGHT * int(
                np.count_nonzero(other & ((cells > 0) != (before > 0)))
            )
            if changes >= self._config.min_changes:
                ranked.append((-changes / (distance + _NEAR_M), place, cells))
            elif held is not None and not changes:
                held.revision = grid.revision
        for _, place, cells in sorted(ranked, key=lambda item: item[:2]):
            if room <= 0 or state.credit_bytes <= 0.0:
                return
            record = GridTile(place.column, place.row, place.storey, grid.config.cell_m, cells)
            state.credit_bytes -= messages.length(record) + _OVERHEAD_BYTES
            channel.put(record)
            state.sent[place] = _Sent(cells, grid.revision)
            room -= 1

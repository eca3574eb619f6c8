"""Where submaps lie in the world w: the first one of all is the world, and what is one map with it follows.

A place is a similarity S_w_m: one eye's submap may have another unit of length than w. The world keeps the unit in
which it began, until a map in metres becomes one with its first submap, or an agent says how long that unit is.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import IntakeConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.intake.intake import Intake
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import Key, SubmapPlacement
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, agent_of_submap, submap_of_keyframe

F64 = NDArray[np.float64]


class World:
    """The places of submaps; agents are told of each change."""

    def __init__(self, config: IntakeConfig, sparse_map: SparseMap, intake: Intake, publisher: Publisher) -> None:
        self._config = config
        self._map = sparse_map
        self._intake = intake
        self._publisher = publisher
        self.placements: dict[SubmapId, F64] = {}  # S_w_m of placed submaps, the first one of all first
        self.carried: dict[SubmapId, F64] = {}  # S_w_m of those that have a place by themselves
        self._withdrawn: list[tuple[AgentId, Key]] = []

    @property
    def first(self) -> SubmapId | None:
        """The submap that is the world."""
        return next(iter(self.placements), None)

    def withdrawn(self) -> tuple[tuple[AgentId, Key], ...]:
        """Places that were said and are true no more, since the last call."""
        gone = tuple((agent, key) for agent, key in self._withdrawn if key.id not in self.placements)
        self._withdrawn.clear()
        return gone

    def set_upright(self) -> bool:
        """Turn the world when the agent of its first submap says which way is up; all that is placed moves along.
        Returns whether it did.
        """
        first = self.first
        level = None if first is None else self._intake.levels.get(first)
        if first is None or level is None:
            return False
        if np.allclose(level.T_l_m[:3, :3], sim3.rigid(self.placements[first])[:3, :3], 0.0, 1e-9):
            return False
        unit = sim3.scale_of(self.placements[first])
        self._move_world(sim3.of(unit, level.T_l_m) @ sim3.inverse(self.placements[first]))
        return True

    def set_metric(self) -> bool:
        """Stretch the world when the agent of its first submap says how long a unit of it is, which nobody knew.
        Returns whether it did.
        """
        first = self.first
        metres = None if first is None else self._intake.units.get(first)
        if first is None or metres is None or not self._map.is_up_to_scale(self._map.map_id(first)):
            return False
        if sim3.scale_of(self.placements[first]) != 1.0 or metres == 1.0:
            return False
        self._move_world(sim3.of(metres, np.eye(4)))
        return True

    def begin(self, keyframe: KeyframeId) -> None:
        """The first submap of all is the world. A later one of the same flight begins where the last was left."""
        submap = submap_of_keyframe(keyframe)
        if submap in self.placements:
            return
        if not self.placements:
            level = self._intake.levels.get(submap)
            S_w_m = np.eye(4) if level is None else level.T_l_m
        else:
            before = SubmapId(submap - 1)
            live, S_w_before = self._intake.last_of.get(before), self.placements.get(before)
            first = self._map.submaps[submap][0]
            begin = self._map.pose(first)
            left = self._map.pose(live.keyframe) if live else None
            if live is None or S_w_before is None or left is None or begin is None:
                return
            tracked_ns = self._intake.tracked_ns.get(before, live.t_ns)
            if self._map.keyframes.t_ns[self._map.rows[first]] - tracked_ns > self._config.carry_s * 1e9:
                return  # a place that it reached unseen: it is found when it is recognised
            there = sim3.place(S_w_before, left @ live.T_k_c)
            unit = sim3.scale_of(S_w_before) if self._map.is_up_to_scale(submap) else 1.0
            S_w_m = sim3.normalise(sim3.of(unit, there) @ se3.inverse(begin))
        self.carried[submap] = S_w_m
        self._set(submap, S_w_m)

    def grow(self, units: Mapping[SubmapId, float]) -> None:
        """Units of submaps have grown in their maps: these stay as long in the world as they were."""
        for submap, more in units.items():
            begin = self._map.first_pose(submap)
            if submap in self.placements:
                self._set(submap, sim3.grown(self.placements[submap], more, begin))
            if submap in self.carried:
                self.carried[submap] = sim3.grown(self.carried[submap], more, begin)

    def part(self, parted: set[SubmapId]) -> None:
        """Submaps that were taken out of a map lie where they lay by themselves, or nowhere; their agents are told."""
        first = self.first
        for submap in sorted(parted & self.placements.keys() - {first}):
            if submap in self.carried:
                self._set(submap, self.carried[submap])
            else:
                del self.placements[submap]
                self._publisher.withdraw_placement(submap)
                self._withdrawn.append((agent_of_submap(submap), Key(SubmapPlacement.KIND, int(submap), 0)))

    def lay_out(self, map_id: SubmapId) -> None:
        """Submaps of one map lie in the world as they lie to each other, as soon as one of them has a place. A map in
        metres keeps them: where the world had another unit, it takes on this one.
        """
        submaps = self._map.submaps_of_map(map_id)
        eldest = self._map.map_id(map_id)
        first = self.first
        anchor = next((s for s in [first, eldest, *submaps] if s in self.placements and s in submaps), None)
        if first is None or anchor is None:
            return
        S_w_i = sim3.normalise(self.placements[anchor] @ sim3.inverse(self._map.submap_pose(anchor)))
        unit = sim3.scale_of(S_w_i)
        if unit != 1.0 and not self._map.is_up_to_scale(eldest):
            at = self.placements[anchor][:3, 3]
            stretch = sim3.of(1.0 / unit, se3.from_rt(np.eye(3), at - at / unit))
            if anchor == first or self._map.is_up_to_scale(self._map.map_id(first)):
                self._move_world(stretch, submaps)
            S_w_i = sim3.normalise(stretch @ S_w_i)
        for submap in submaps:
            S_w_m = sim3.normalise(S_w_i @ self._map.submap_pose(submap))
            held = self.placements.get(submap)
            if held is None or not np.allclose(held, S_w_m, rtol=0.0, atol=1e-5):
                self._set(submap, S_w_m)

    # -- inside ------------------------------------------------------------------------------------------------------

    def _set(self, submap: SubmapId, S_w_m: F64) -> None:
        self.placements[submap] = S_w_m
        self._publisher.publish_placement(submap, S_w_m)

    def _move_world(self, S_new_old: F64, but: Collection[SubmapId] = ()) -> None:
        """Turn or stretch the world with all that is placed in it, but for some; metres stay metres."""
        self.carried = {s: self._moved(s, S_new_old, S) for s, S in self.carried.items()}
        for submap, S_w_m in self.placements.items():
            if submap not in but:
                self._set(submap, self._moved(submap, S_new_old, S_w_m))

    def _moved(self, submap: SubmapId, S_new_old: F64, S_w_m: F64) -> F64:
        """Where a submap lies in a world that moved: where its first keyframe does, as long as it is in metres."""
        if sim3.scale_of(S_new_old) == 1.0 or self._map.is_up_to_scale(submap):
            return sim3.normalise(S_new_old @ S_w_m)
        begin = self._map.first_pose(submap)
        return se3.orthonormalise(sim3.place(S_new_old, sim3.place(S_w_m, begin)) @ se3.inverse(begin))

"""Placements of submaps in the world w.

The first submap of all defines w; submaps merged with it follow. A placement is a similarity S_w_m: a monocular submap
may have another unit of length than w. w keeps the unit in which it began until a map in metres is merged with its
first submap, or an agent reports how long that unit is.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.intake.intake import Intake
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.map.world_poses import is_near
from kiteline_codec.coding.quantise import MAX_SCALE, MIN_SCALE
from kiteline_codec.schema import KeyframePose, SubmapPlacement, messages
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import KeyframeId, SubmapId, agent_of_submap, submap_of_keyframe

_ODOMETRY_GAP_S = 1.5  # s; a submap that begins within this time of the last one is placed by odometry
_TIE_M = 0.2  # m; deviation of the motion over a loss up to which it places a submap: half a metre at worst
_TIE_RAD = 0.03  # rad; the same of the rotation
_LATE_TIE_S = 2.0  # s of a submap after which no tie to the one before is awaited: it would have come with it


@dataclass(frozen=True, slots=True)
class PlacementState:
    """State of `SubmapPlacements` that outlives the process, in order of placing."""

    S_w_m: Mapping[SubmapId, F64] = field(default_factory=dict)
    unmerged: Mapping[SubmapId, F64] = field(default_factory=dict)
    recognised: frozenset[SubmapId] = frozenset()


class SubmapPlacements:
    """S_w_m of all placed submaps; every change is published to the agent of the submap."""

    def __init__(self, sparse_map: SparseMap, intake: Intake, publisher: Publisher) -> None:
        self._map = sparse_map
        self._intake = intake
        self._publisher = publisher
        self.S_w_m: dict[SubmapId, F64] = {}  # the first submap of all comes first
        self.unmerged: dict[SubmapId, F64] = {}  # S_w_m of submaps that have a placement without a merge
        self._recognised: set[SubmapId] = set()  # submaps whose placement rests on a merge with another submap
        self.far = 0  # placements that were left out: they have no code
        self._told: dict[SubmapId, SubmapPlacement] = {}  # by an earlier process, until its state is restored
        self._scale_sigma: dict[SubmapId, float] = {}  # relative deviation of lengths, where accelerations told it
        self._withdrawn: list[SubmapId] = []  # that lost their placements, and agents were not told yet

    @property
    def first(self) -> SubmapId | None:
        """The submap that defines w."""
        return next(iter(self.S_w_m), None)

    def align_with_gravity(self) -> bool:
        """Rotate w, and all that is placed in it, when the first submap's gravity is known. True if it moved."""
        first = self.first
        gravity = None if first is None else self._intake.gravity.get(first)
        if first is None or gravity is None:
            return False
        if np.allclose(gravity.T_l_m[:3, :3], sim3.rigid(self.S_w_m[first])[:3, :3], 0.0, 1e-9):
            return False
        scale = sim3.scale_of(self.S_w_m[first])
        S_l_m = sim3.of(scale, sim3.with_scaled_translation(gravity.T_l_m, scale))
        return self._move_world(S_l_m @ sim3.inverse(self.S_w_m[first]))

    def make_metric(self) -> bool:
        """Scale what agents told the metre of: w by the first submap, in a w in metres others that lie alone.

        Returns True if something changed.
        """
        waiting, self._intake.fresh_scales = sorted(self._intake.fresh_scales), set()
        changed = False
        for submap in waiting:
            placed, metres = self.S_w_m.get(submap), self._map.metres_per_unit[submap]
            if not self._map.is_up_to_scale(self._map.map_id(submap)):
                continue
            if placed is None:
                if self._place_waiting(submap):
                    changed = True
                else:
                    self._intake.fresh_scales.add(submap)
                continue
            factor = metres / sim3.scale_of(placed)
            if submap == self.first:
                changed = self._move_world(sim3.of(factor, np.eye(4))) or changed
            elif self._in_metres and self._map.submaps_of_map(submap) == [submap]:
                S_w_m = sim3.scaled_about(placed, factor, self._map.first_pose(submap))
                if self._place(submap, S_w_m):
                    self._move_later(submap, S_w_m @ sim3.inverse(placed))
                    changed = True
        return changed

    @property
    def _in_metres(self) -> bool:
        """True if w is in metres."""
        first = self.first
        if first is None:
            return False
        return first in self._map.metres_per_unit or not self._map.is_up_to_scale(self._map.map_id(first))

    def place_new(self, keyframe: KeyframeId) -> None:
        """Place the submap of a new keyframe: the first of all at w, a later one where the last one was left.

        It begins a new w if nothing tells how it lies to the placed ones, which are its agent's, and they would keep
        grid and poses out of w for the rest of the flight: it is in metres and they are not, or they are of a keyframe
        each, by which no place is recognised. Those return by a merge.
        """
        submap = submap_of_keyframe(keyframe)
        if submap in self.S_w_m or self._place_by_tie(submap):
            return
        if self._has_to_begin_anew(submap, keyframe):
            self._withdraw(list(self.S_w_m))
        if self.S_w_m:
            self._place_by_odometry(submap)
            return
        gravity = self._intake.gravity.get(submap)
        self._place(submap, np.eye(4) if gravity is None else gravity.T_l_m)

    def _place_waiting(self, submap: SubmapId) -> bool:
        """Place a submap whose unit was not known, and those that follow it. False if the first one has no place."""
        first = submap
        while submap not in self.S_w_m and (self._place_by_tie(submap) or self._place_by_odometry(submap)):
            submap = SubmapId(submap + 1)
        return submap != first

    def _place_by_odometry(self, submap: SubmapId) -> bool:
        """Place a submap where its agent left the one before; False if that is not known, or how long its unit is."""
        before, keyframes = SubmapId(submap - 1), self._map.submaps.get(submap)
        live, S_w_before = self._intake.last_pose.get(before), self.S_w_m.get(before)
        T_m_first = self._map.pose(keyframes[0]) if keyframes else None
        T_before_k = self._map.pose(live.keyframe) if live else None
        if live is None or S_w_before is None or T_before_k is None or T_m_first is None or not keyframes:
            return False
        tracked_ns = self._intake.tracked_ns.get(before, live.t_ns)
        if self._map.keyframes.t_ns[self._map.rows[keyframes[0]]] - tracked_ns > _ODOMETRY_GAP_S * 1e9:
            return False  # too long without images: a loop closure has to place it
        scale: float | None = 1.0
        if self._map.is_up_to_scale(submap):
            in_metres = not self._map.is_up_to_scale(self._map.map_id(before))
            # Without a tie nothing measured the way over the loss: it would lie as if its unit were a metre.
            scale = self._map.metres_per_unit.get(submap) if in_metres else sim3.scale_of(S_w_before)
        if scale is None:
            return False
        T_w_c = sim3.place(S_w_before, T_before_k @ live.T_k_c)
        return self._place(submap, sim3.normalise(sim3.of(scale, T_w_c) @ se3.inverse(T_m_first)))

    def _has_to_begin_anew(self, submap: SubmapId, keyframe: KeyframeId) -> bool:
        """True if nothing tells how a submap lies to the placed ones, which are its agent's, and nothing will."""
        tie = self._intake.loss_ties.get(submap)
        tied = tie is not None and submap_of_keyframe(tie.since) in self.S_w_m
        first_in_metres = submap in self._map.metric_submaps and not self._in_metres
        if tied or not (first_in_metres or self._places_single_keyframes(submap)):
            return False
        stamps = self._map.keyframes.t_ns[[self._map.rows[k] for k in (self._map.submaps[submap][0], keyframe)]]
        if stamps[1] - stamps[0] < _LATE_TIE_S * 1e9:
            return False
        return {agent_of_submap(placed) for placed in self.S_w_m} == {agent_of_submap(submap)}

    def _places_single_keyframes(self, submap: SubmapId) -> bool:
        """True if each placed submap is a keyframe alone, as of a start that was broken off, and in no better unit."""
        if self._in_metres and self._map.is_up_to_scale(submap):
            return False
        return all(self._map.submaps_of_map(s) == [s] and len(self._map.submaps[s]) == 1 for s in self.S_w_m)

    def tell_rooted(self) -> None:
        """Publish the poses that were chosen for keyframes at which submaps begin without their first ones."""
        for keyframe in self._intake.take_rooted():
            self._publisher.mark_changed(KeyframePose.KIND, keyframe)

    def follow_ties(self) -> bool:
        """Place submaps that are not recognised by their agents' motion over a loss. True if one moved.

        Submaps that were placed after such a submap, by how the agent left it, move along.
        """
        fresh, self._intake.fresh_ties = sorted(self._intake.fresh_ties), set()
        moved = False
        for submap in fresh:
            before = self.S_w_m.get(submap)
            if not self._place_by_tie(submap):
                continue
            moved = True
            if before is not None:
                self._move_later(submap, self.S_w_m[submap] @ sim3.inverse(before))
        return moved

    def _move_later(self, submap: SubmapId, S_new_old: F64) -> None:
        """Move the submaps that follow one without a break, as far as none is recognised, by S_new_old (4,4) in w."""
        later = SubmapId(submap + 1)
        while later in self.unmerged and later in self.S_w_m and self._map.submaps_of_map(later) == [later]:
            self._place(later, self._moved(later, S_new_old, self.unmerged[later]))
            later = SubmapId(later + 1)

    def _place_by_tie(self, submap: SubmapId) -> bool:
        """Place a submap by its agent's motion over a loss; False if that is too uncertain, or not known yet."""
        tie = self._intake.loss_ties.get(submap)
        if tie is None or submap == self.first or tie.sigma_m > _TIE_M or tie.sigma_rad > _TIE_RAD:
            return False
        before, alone = submap_of_keyframe(tie.since), self._map.submaps_of_map(submap) == [submap]
        S_w_before, T_before_k = self.S_w_m.get(before), self._map.pose(tie.since)
        keyframes = self._map.submaps.get(submap)
        T_m_first = self._map.pose(keyframes[0]) if keyframes else None
        if S_w_before is None or T_before_k is None or T_m_first is None or not alone or before == submap:
            return False
        if agent_of_submap(before) != agent_of_submap(submap):
            return False
        T_w_first = sim3.place(S_w_before, T_before_k @ tie.T_k_f)
        scale = sim3.scale_of(S_w_before) if self._map.is_up_to_scale(submap) else 1.0
        return self._place(submap, sim3.normalise(sim3.of(scale, T_w_first) @ se3.inverse(T_m_first)))

    def rescale(self, factors: Mapping[SubmapId, float], scale_sigma: Mapping[SubmapId, float]) -> None:
        """Scale placements of submaps whose units grew in their maps, about their first keyframes.

        scale_sigma: relative deviations of lengths, by map id, which are told.
        """
        for map_id, sigma in scale_sigma.items():
            submaps = self._map.submaps_of_map(map_id)
            self._scale_sigma |= dict.fromkeys(submaps, sigma)
            for submap in submaps:
                if submap in self.S_w_m and submap in self._map.scaled_submaps and submap not in factors:
                    self._set(submap, self.S_w_m[submap])
        for submap, factor in factors.items():
            first = self._map.first_pose(submap)
            if submap in self.S_w_m:
                self._set(submap, sim3.scaled_about(self.S_w_m[submap], factor, first))
            if submap in self.unmerged:
                self.unmerged[submap] = sim3.scaled_about(self.unmerged[submap], factor, first)

    def separate(self, split: Collection[SubmapId]) -> None:
        """Move submaps of maps that were one back to where they lay before, but those in the map that defines w.

        Others have no placement any more.
        """
        here = None if self.first is None else self._map.map_id(self.first)
        for submap in sorted(set(split) & self.S_w_m.keys()):
            if self._map.map_id(submap) == here:
                continue
            self._recognised.discard(submap)
            if submap in self.unmerged:
                self._set(submap, self.unmerged[submap])
            else:
                self._withdraw([submap])

    def take_withdrawn(self) -> list[SubmapId]:
        """Submaps that lost their placements since the last call, of which agents have to be told."""
        withdrawn, self._withdrawn = self._withdrawn, []
        return withdrawn

    def _withdraw(self, submaps: Collection[SubmapId]) -> None:
        for submap in submaps:
            self.delete(submap)
        self._withdrawn += submaps

    def delete(self, submap: SubmapId) -> None:
        """Drop the placement of a submap, also one that has not been sent yet."""
        self._publisher.withdraw_placement(submap)
        self.S_w_m.pop(submap, None)
        self.unmerged.pop(submap, None)
        self._scale_sigma.pop(submap, None)
        self._recognised.discard(submap)

    def update_map(self, map_id: SubmapId) -> None:
        """Place all submaps of a map as they lie to each other, if one of them is placed.

        A map in metres keeps its unit: if w had another unit, w is rescaled.
        """
        submaps = self._map.submaps_of_map(map_id)
        root = self._map.map_id(map_id)
        first = self.first
        anchor = next((s for s in [first, root, *submaps] if s in self.S_w_m and s in submaps), None)
        if first is None or anchor is None:
            return
        S_w_map = sim3.normalise(self.S_w_m[anchor] @ sim3.inverse(self._map.submap_pose(anchor)))
        scale = sim3.scale_of(S_w_map)
        if scale != 1.0 and not self._map.is_up_to_scale(root):
            at = self.S_w_m[anchor][:3, 3]
            rescale = sim3.of(1.0 / scale, se3.from_rt(np.eye(3), at - at / scale))
            if anchor == first or self._map.is_up_to_scale(self._map.map_id(first)):
                self._move_world(rescale, submaps)
            S_w_map = sim3.normalise(rescale @ S_w_map)
        for submap in submaps:
            S_w_m = sim3.normalise(S_w_map @ self._map.submap_pose(submap))
            held = self.S_w_m.get(submap)
            newly = submap != anchor and submap not in self._recognised
            if newly:
                self._recognised.add(submap)
            if newly or held is None or not np.allclose(held, S_w_m, rtol=0.0, atol=1e-5):
                self._set(submap, S_w_m, urgent=newly)

    def state(self) -> PlacementState:
        """State to be saved."""
        return PlacementState(dict(self.S_w_m), dict(self.unmerged), frozenset(self._recognised))

    def restore(self, state: PlacementState) -> None:
        """Continue from a saved state, after `restore_told`. What had not been told as it is there is published."""
        self.S_w_m.update(state.S_w_m)
        self.unmerged = dict(state.unmerged)
        self._recognised = set(state.recognised)
        told, self._told = self._told, {}
        for submap, S_w_m in self.S_w_m.items():
            record = SubmapPlacement(submap, S_w_m, submap in self._recognised)
            before = replace(told[submap], batch=0, scale_sigma=0.0) if submap in told else None
            if before is None or not _has_code(S_w_m) or messages.encode(record) != messages.encode(before):
                self._set(submap, S_w_m)

    def restore_told(self, record: SubmapPlacement) -> None:
        """Take in a placement that an earlier process published, and its deviation of lengths."""
        self._told[record.submap] = record
        if record.scale_sigma > 0.0:
            self._scale_sigma[record.submap] = record.scale_sigma
            self._map.scaled_submaps.add(record.submap)

    def _place(self, submap: SubmapId, S_w_m: F64) -> bool:
        """Place a submap without a merge; False if it would lie too far off."""
        if not self._set(submap, S_w_m):
            return False
        self.unmerged[submap] = S_w_m
        return True

    def _set(self, submap: SubmapId, S_w_m: F64, *, urgent: bool = False) -> bool:
        """Set and publish a placement; False, and it stays as it is, if it has no code."""
        if not _has_code(S_w_m):
            self.far += 1
            return False
        self.S_w_m[submap] = S_w_m
        recognised, sigma = submap in self._recognised, self._scale_sigma.get(submap, 0.0)
        self._publisher.publish_placement(submap, S_w_m, recognised=recognised, scale_sigma=sigma, urgent=urgent)
        return True

    def _move_world(self, S_new_old: F64, but: Collection[SubmapId] = ()) -> bool:
        """Move all placements, except some, to a rotated or rescaled world; submaps in metres keep their scale.

        False if the submap that defines w would lie too far off: then none moves.
        """
        moved = {s: self._moved(s, S_new_old, S_w_m) for s, S_w_m in self.S_w_m.items() if s not in but}
        first = self.first
        if first in moved and not _has_code(moved[first]):
            return False
        unmerged = {s: self._moved(s, S_new_old, S) for s, S in self.unmerged.items()}
        self.unmerged = {s: S if _has_code(S) else self.unmerged[s] for s, S in unmerged.items()}
        for submap, S_w_m in moved.items():
            self._set(submap, S_w_m)
        return True

    def _moved(self, submap: SubmapId, S_new_old: F64, S_w_m: F64) -> F64:
        """Placement of a submap in a moved world; one in metres moves rigidly, with its first keyframe."""
        if sim3.scale_of(S_new_old) == 1.0 or self._map.is_up_to_scale(submap):
            return sim3.normalise(S_new_old @ S_w_m)
        first = self._map.first_pose(submap)
        T_w_k = sim3.place(S_new_old, sim3.place(S_w_m, first))
        return sim3.normalise(sim3.of(sim3.scale_of(S_w_m), T_w_k) @ se3.inverse(first))


def _has_code(S_w_m: F64) -> bool:
    """True if a placement can be sent."""
    return is_near(S_w_m) and MIN_SCALE <= sim3.scale_of(S_w_m) <= MAX_SCALE

"""Records of the base: corrections of the local map, cached keyframes, submap placements, grid tiles."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from kiteline_agent.config import SmoothingConfig
from kiteline_agent.exchange.correction_batches import ReceivedBatches
from kiteline_agent.exchange.correction_filter import CorrectionFilter
from kiteline_agent.exchange.smoothing import Smoothing
from kiteline_agent.exchange.whole_map_motion import WholeMapMotion
from kiteline_agent.local_map.fused_landmarks import FusedInMap
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_agent.tracking.map_anchor import MapAnchor
from kiteline_codec.schema import (
    CachedKeyframe,
    CachedLandmarks,
    CulledLandmarks,
    DisparityCalibration,
    FusedLandmarks,
    GravityAlignment,
    GridTile,
    Key,
    KeyframePose,
    Record,
    RefinedLandmarks,
    RemovedObservations,
    SubmapPlacement,
)
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import NO_KEYFRAME, SEQUENCE_BITS, SubmapId

_SAME_TILT = 0.9999  # cosine of the angle, 0.8 degrees, between verticals that agree: gravity is known to half a degree
_SAME_UNIT = 0.2  # difference of the scale from 1 up to which w is in metres too, as IMU and base estimate them


class Corrections:
    """Applies the base's records, one handler for each kind, and holds where submaps lie in the world."""

    def __init__(
        self, local_map: LocalMap, cache: MapCache, smoothing: SmoothingConfig,
        calibrate: Callable[[DisparityCalibration], list[str]] | None = None, most_tiles: int = 512,
    ) -> None:  # fmt: skip
        """calibrate: takes over an offset of disparities, and returns events; None without a right camera.

        most_tiles: tiles that are kept.
        """
        self._map = local_map
        self._calibrate = calibrate
        self._cache = cache
        self._smoothing = Smoothing(smoothing)
        self._filter = CorrectionFilter(smoothing)
        self._whole = WholeMapMotion(smoothing)
        self._scale_sigma: dict[SubmapId, float] = {}  # relative deviation of lengths in w, by submap
        self._batches = ReceivedBatches()
        self._fused = FusedInMap(local_map)
        self._S_w_m: dict[SubmapId, F64] = {}
        self._recognised: set[SubmapId] = set()  # submaps whose placement rests on a merge at the base
        self._continued: SubmapId | None = None  # submap that began in a tracked frame
        self._own_world: SubmapId | None = None  # submap that is w until it is placed: the agent moved it
        self._upright: GravityAlignment | None = None  # of the submap that began in motion
        self._most_tiles = most_tiles
        self.tiles: dict[tuple[int, int], GridTile] = {}
        self._handlers: Mapping[type[Record], Callable[[Any], None]] = {
            KeyframePose: local_map.set_pose,
            RefinedLandmarks: local_map.refine,
            FusedLandmarks: self._fused.take,
            RemovedObservations: local_map.remove,
            CulledLandmarks: local_map.remove,
            SubmapPlacement: self._place,
            CachedKeyframe: cache.store,
            CachedLandmarks: cache.store,
            DisparityCalibration: self._take_calibration,
            GridTile: self._add_tile,
        }
        self._events: list[str] = []  # of the records that are being applied

    def take(
        self, records: Sequence[Record], removed: Sequence[Key], anchor: MapAnchor | None = None
    ) -> tuple[bool, list[str]]:
        """Apply records, and drop what the base removed. Returns whether the local map moved, and events.

        anchor: what the last frame tracked, if it did. Corrections that move less than both maps' errors there wait.
        """
        self._events = []
        for record in self._batches.take(records, removed):
            handler = self._handlers.get(type(record))
            if handler is not None:
                handler(record)
        moved = bool(records) and self._apply_corrections(anchor)
        self._cache.remove(removed)
        for key in removed:
            if key.kind == SubmapPlacement.KIND:
                self._withdraw(SubmapId(key.id))
            if key.kind == GridTile.KIND:  # far away, or of another storey
                column, row, storey = GridTile.place(key)
                if (held := self.tiles.get((column, row))) is not None and held.storey == storey:
                    del self.tiles[column, row]
        return moved, self._events

    def _apply_corrections(self, anchor: MapAnchor | None) -> bool:
        """Take over the corrections that wait, if they matter in the last frame. Returns whether the map moved."""
        if not (self._map.due and self._map.held.fit(self._map.keyframe, self._map.parent)):
            return False
        m = self._map
        m.held.adapt(m.keyframe, m.parent, m.T_m_k, m.camera.bf, m.least_rho)
        slots = self._slots_of_active()
        poses = m.T_m_k[slots]
        if anchor is not None:
            before = self._map.save()
            self._map.try_corrections(anchor.keyframes)
            self._map.compose_unplaced()
            if not anchor.matters():
                self._map.restore(before)
                return False
        self._map.apply_corrections()
        self._map.compose_unplaced()
        self._fused.corrected()
        S_w_m = self._S_w_m.get(self._map.active)
        if S_w_m is not None:
            self._whole.add(poses, self._map.T_m_k[slots], S_w_m)
        return True

    def _slots_of_active(self) -> I64:
        """Slots of the keyframes of the active submap, the one seen last at the end."""
        m = self._map
        slots = np.flatnonzero((m.keyframe != NO_KEYFRAME) & (m.keyframe >> SEQUENCE_BITS == m.active))
        return np.asarray(slots[np.argsort(m.last_seen[slots], kind="stable")])

    def _place(self, record: SubmapPlacement) -> None:
        if not record.recognised and self._contradicts_gravity(record.submap, record.S_w_m):
            return  # sent before the base knew of gravity; the upright placement follows
        self._leave_own_world(record.submap, record.S_w_m)
        self._S_w_m[record.submap] = record.S_w_m
        self._scale_sigma[record.submap] = record.scale_sigma
        if record.recognised:
            lost_before = record.submap == self._map.active and record.submap != self._continued
            if record.submap not in self._recognised and lost_before:
                self._filter.clear()
                self._whole.clear()
                self._smoothing.snap()  # a merge: until now the submap lay where odometry put it
            self._recognised.add(record.submap)
        else:
            self._recognised.discard(record.submap)

    def _withdraw(self, submap: SubmapId) -> None:
        """A submap has no place in w any more: its merge was undone, or its map is deleted.

        Live poses of the active one do not go on in w from where it lay.
        """
        if submap == self._own_world:  # its placement was not applied yet
            return
        self._S_w_m.pop(submap, None)
        self._recognised.discard(submap)
        if submap == self._map.active:
            self._clear_live()

    def _take_calibration(self, record: DisparityCalibration) -> None:
        if self._calibrate is not None:
            self._events += self._calibrate(record)

    def _add_tile(self, record: GridTile) -> None:
        self.tiles[record.column, record.row] = record
        if len(self.tiles) > self._most_tiles:  # the base sends what lies near: the farthest from that goes
            del self.tiles[max(self.tiles, key=lambda at: max(abs(at[0] - record.column), abs(at[1] - record.row)))]

    def note_continued(self, submap: SubmapId) -> None:
        """A submap began in a tracked frame: odometry places it well, and its merge is a correction like others."""
        self._continued = submap

    def continue_in_metres(self, submap: SubmapId, old: SubmapId, unit_m: float) -> None:
        """A submap in metres began where the old one is tracked, with its axes. unit_m: metres, one unit of that.

        Live poses go on where the base will place it: it scales w as long as the old one is its first submap.
        """
        self.leave_world()
        S_w_old = self._S_w_m.get(old)
        if S_w_old is not None:
            self._S_w_m[submap] = sim3.with_scaled_translation(sim3.rigid(S_w_old), unit_m / sim3.scale_of(S_w_old))

    def leave_world(self) -> None:
        """Odometry does not lead on in w: live poses are in it again once the active submap is placed."""
        self._clear_live()
        self._own_world = None

    def _clear_live(self) -> None:
        """Live poses begin anew where the active submap lies then."""
        for state in (self._smoothing, self._filter, self._whole):
            state.clear()

    def is_recognised(self, submap: SubmapId) -> bool:
        """True if the base merged a submap with another one: its pose there rests on more than odometry."""
        return submap in self._recognised

    def set_upright(self, alignment: GravityAlignment) -> None:
        """Place a gravity-aligned submap until the base's placement is upright too, which takes seconds on a thin link.

        A placement that rests on a merge stands: the world of another agent need not be level.
        """
        self._upright = alignment
        held = self._S_w_m.get(alignment.submap)
        recognised = alignment.submap in self._recognised
        if held is None or (not recognised and self._contradicts_gravity(alignment.submap, held)):
            self._leave_own_world(alignment.submap, alignment.T_l_m)
            self._S_w_m[alignment.submap] = alignment.T_l_m

    def move_on_board(self, submap: SubmapId, T_o_m: F64) -> None:
        """The agent moved the map of a submap, which lay at T_o_m (4,4) before: live poses follow without a jump.

        With a base or without. Until the submap is placed, live poses stay in its frame.
        """
        if submap not in self._S_w_m and self._smoothing.held is None:
            self._S_w_m[submap], self._own_world = np.eye(4), submap
            self._smoothing.begin(se3.inverse(T_o_m))
        self._smoothing.hasten()

    def _leave_own_world(self, submap: SubmapId, S_w_m: F64) -> None:
        """A submap is placed (4,4): live poses change their frame at once if w was a submap until now.

        Nothing tells where that lies in w if it is not placed itself: live poses begin anew in the active one.
        """
        own = self._own_world
        if own is None or submap not in (own, self._map.active):
            return
        self._own_world = None
        if submap == own:
            self._smoothing.change_world(S_w_m)
            self._whole.change_world(S_w_m)
        else:
            self._S_w_m.pop(own, None)
            self._smoothing.snap()
            self._whole.clear()

    def _contradicts_gravity(self, submap: SubmapId, S_w_m: F64) -> bool:
        """True if a placement contradicts the vertical that the agent measured in the submap."""
        if self._upright is None or self._upright.submap != submap:
            return False
        up, told = self._upright.T_l_m[2, :3], sim3.rigid(S_w_m)[2, :3]
        return float(up @ told) < _SAME_TILT

    def in_world(self, submap: SubmapId, T_m_b: F64, T_o_m: F64, t_ns: int, *, metric: bool) -> F64 | None:
        """T_w_b (4,4), with corrections smoothed, but for what moved the map as a whole; None if it is not placed.

        A new submap in metres continues where odometry puts it in the world, until it is placed.
        m and o share a unit of length; if w has another one, as with a monocular camera, the placement has a scale.
        """
        S_w_m = self._S_w_m.get(submap)
        if S_w_m is None:
            held = self._smoothing.held
            self._smoothing.hold(t_ns)
            if held is None or not metric or abs(sim3.scale_of(held) - 1.0) >= _SAME_UNIT:
                return None
            return self._body_in_world(held, T_o_m @ T_m_b)
        if not self._smoothing.on:
            return self._body_in_world(S_w_m, T_m_b)
        T_o_b = T_o_m @ T_m_b
        here = T_o_b[:3, 3]
        S_v_m = self._whole.leave_out(S_w_m, T_m_b[:3, 3])
        scale_sigma = self._scale_sigma.get(submap, 0.0)
        T_w_o = self._filter.weigh(S_v_m @ se3.inverse(T_o_m), here, scale_sigma)
        # Where lengths are uncertain, a faster correction would stretch the path while it lasts by more than they are.
        return self._body_in_world(self._smoothing.follow(T_w_o, here, t_ns, by_share=scale_sigma > 0.0), T_o_b)

    def relocalise(self, T_o_n: F64) -> None:
        """A relocalisation found that o lies elsewhere in the map, at n: live poses follow at once, as without a base.

        T_o_n: (4,4). What dead reckoning was off by is no correction of the base, which would be smoothed.
        """
        self._smoothing.move_odometry(T_o_n)
        self._filter.move_odometry(T_o_n)

    def in_base_map(self, submap: SubmapId, T_m_b: F64) -> F64 | None:
        """T_w_b (4,4) as corrected last, for what the base tells of w, such as tiles; None if it is not placed."""
        S_w_m = self._S_w_m.get(submap)
        return None if S_w_m is None else self._body_in_world(S_w_m, T_m_b)

    def _body_in_world(self, S_w_x: F64, T_x_b: F64) -> F64:
        """T_w_b (4,4). S_w_x scales the camera's position, but not the lever arm to the body, which is in metres."""
        if sim3.scale_of(S_w_x) == 1.0:
            return S_w_x @ T_x_b
        T_b_c = self._map.camera.T_b_c
        return sim3.place(S_w_x, T_x_b @ T_b_c) @ se3.inverse(T_b_c)

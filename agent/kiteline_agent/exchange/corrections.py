"""What the base says: corrections of the local map, copies, where submaps lie in the world, tiles of the grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import SmoothingConfig
from kiteline_agent.exchange.smoothing import Smoothing
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.map_cache import MapCache
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
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import MAX_SUBMAPS, SubmapId

F64 = NDArray[np.float64]

_MOVED_M = 5e-3  # a placement that differs by less is the same one, coded anew
_GUESSED_M = 0.5  # by which a base that has only the odometry's word differs from it: a frame's motion


class Corrections:
    """Takes records to where they belong, and knows the world as far as the base told of it."""

    def __init__(self, local_map: LocalMap, cache: MapCache, smoothing: SmoothingConfig) -> None:
        self._map = local_map
        self._cache = cache
        self._smoothing = Smoothing(smoothing)
        self._S_w_m: dict[SubmapId, F64] = {}
        self._guessed: dict[SubmapId, F64] = {}  # where the odometry, and then a base, had submaps begin: T_first_m
        self._told: set[SubmapId] = set()  # those of which a base has spoken
        self._heard = False  # a base has just spoken of some
        self._placed: set[SubmapId] = set()  # those that a base has put where nobody had guessed them
        self.tiles: dict[tuple[int, int], GridTile] = {}

    def take(self, records: Sequence[Record], removed: Sequence[Key]) -> tuple[bool, list[str]]:
        """Apply records, and drop what the base removed. Returns whether the local map moved, and events."""
        touched, events = False, list[str]()
        for record in records:
            if isinstance(
                record, KeyframePose | RefinedLandmarks | FusedLandmarks | RemovedObservations | CulledLandmarks
            ):
                touched |= self._map.apply(record)
            elif isinstance(record, SubmapPlacement):
                self._S_w_m[record.submap] = record.S_w_m
                self._heard = True
            elif isinstance(record, CachedKeyframe | CachedLandmarks):
                self._cache.store(record)
            elif isinstance(record, DisparityCalibration) and self._map.camera.stereo:
                self._map.set_disparity_offset(record.disparity_px)
                events.append(f"disparities in the middle are {record.disparity_px[0]:+.3f} px too large")
            elif isinstance(record, GridTile):
                self.tiles[record.column, record.row] = record
        if self._heard:
            self._compare()
        self._cache.remove(removed)
        for key in removed:
            if key.kind == SubmapPlacement.KIND:  # the map was taken out of a larger one, and has no place any more
                self._S_w_m.pop(SubmapId(key.id), None)
                self._placed.discard(SubmapId(key.id))
        if touched:
            self._map.compose_unplaced()
        return touched, events

    def begins(self, submap: SubmapId, T_first_m: F64) -> None:
        """A submap begins, which lies at T_first_m (4,4) in the flight's first by odometry."""
        self._guessed[submap] = T_first_m

    def has_placed(self, submap: SubmapId) -> bool:
        """Whether a base knows by more than odometry how a submap lies to the flight's first: it was recognised."""
        return submap in self._placed

    def _compare(self) -> None:
        """A base that has recognised nothing says what the odometry says, and from then on the same."""
        self._heard = False
        for submap in self._guessed.keys() & self._S_w_m.keys():
            first = SubmapId(submap - submap % MAX_SUBMAPS)
            if first not in self._S_w_m:
                continue
            T_first_m = np.linalg.inv(self._S_w_m[first]) @ self._S_w_m[submap]
            apart_m = float(np.linalg.norm(T_first_m[:3, 3] - self._guessed[submap][:3, 3]))
            if submap not in self._told and apart_m < _GUESSED_M:
                self._guessed[submap], apart_m = T_first_m, 0.0
            self._told.add(submap)
            if apart_m > _MOVED_M:
                self._placed.add(submap)
            else:
                self._placed.discard(submap)

    def set_upright(self, level: GravityAlignment) -> None:
        """Where a submap lies until the base says so, who sets it upright too; over a thin link that takes seconds."""
        self._S_w_m.setdefault(level.submap, level.T_l_m)

    def in_world(self, submap: SubmapId, T_m_b: F64, T_o_m: F64, t_ns: int) -> F64 | None:
        """T_w_b (4,4) as it is told: corrections arrive at once, or slowly. None where the submap has no place yet.

        Odometry has the unit of length of the submap; where one eye's is not the world's, its place says the scale.
        """
        S_w_m = self._S_w_m.get(submap)
        if S_w_m is None:
            return None
        if not self._smoothing.on:
            return self._in_unit(S_w_m, T_m_b)
        T_o_b = T_o_m @ T_m_b
        return self._in_unit(self._smoothing.follow(S_w_m @ se3.inverse(T_o_m), T_o_b[:3, 3], t_ns), T_o_b)

    def _in_unit(self, S_w_x: F64, T_x_b: F64) -> F64:
        """T_w_b (4,4) of a body; the arm from eye to body is in metres, whatever the unit in which the eye measures."""
        if sim3.scale_of(S_w_x) == 1.0:
            return S_w_x @ T_x_b
        T_b_c = self._map.camera.T_b_c
        return sim3.place(S_w_x, T_x_b @ T_b_c) @ se3.inverse(T_b_c)

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
from kiteline_core.ids import SubmapId

F64 = NDArray[np.float64]


class Corrections:
    """Takes records to where they belong, and knows the world as far as the base told of it."""

    def __init__(self, local_map: LocalMap, cache: MapCache, smoothing: SmoothingConfig) -> None:
        self._map = local_map
        self._cache = cache
        self._smoothing = Smoothing(smoothing)
        self._S_w_m: dict[SubmapId, F64] = {}
        self._recognised: set[SubmapId] = set()  # submaps whose placement rests on a merge at the base
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
                if record.recognised:
                    self._recognised.add(record.submap)
                else:
                    self._recognised.discard(record.submap)
            elif isinstance(record, CachedKeyframe | CachedLandmarks):
                self._cache.store(record)
            elif isinstance(record, DisparityCalibration) and self._map.camera.stereo:
                self._map.set_disparity_offset(record.disparity_px)
                events.append(f"disparities in the middle are {record.disparity_px[0]:+.3f} px too large")
            elif isinstance(record, GridTile):
                self.tiles[record.column, record.row] = record
        self._cache.remove(removed)
        for key in removed:
            if key.kind == SubmapPlacement.KIND:  # the map was taken out of a larger one, and has no place any more
                self._S_w_m.pop(SubmapId(key.id), None)
                self._recognised.discard(SubmapId(key.id))
        if touched:
            self._map.compose_unplaced()
        return touched, events

    def is_recognised(self, submap: SubmapId) -> bool:
        """True if the base merged a submap with another one: its pose there rests on more than odometry."""
        return submap in self._recognised

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

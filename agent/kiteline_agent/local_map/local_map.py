"""What the agent remembers: a bounded number of keyframes, and the points born in them with their templates.

Structure of arrays with fixed capacity: slot k holds a keyframe, row k * births + i the point born at its keypoint i.
A point is a bearing in its keyframe and an inverse depth, so a corrected keyframe carries its points along. Keyframes
of several submaps are remembered side by side; only those of the active one are tracked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import DepthFilterConfig, LocalMapConfig
from kiteline_agent.imaging.alignment_kernels import TEMPLATE, TEMPLATE_LEVELS
from kiteline_agent.local_map import projection_kernels as kernels
from kiteline_codec.schema import (
    CulledLandmarks,
    FusedLandmarks,
    KeyframeHeader,
    KeyframePose,
    RefinedLandmarks,
    RemovedObservations,
)
from kiteline_core.geometry import disparity_offset
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import KEYPOINT_BITS, NO_KEYFRAME, SEQUENCE_BITS, KeyframeId, SubmapId, point_id

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_SEED_DEPTH_M = 1e4  # stands in for infinity where a birth has no depth


@dataclass(frozen=True, slots=True)
class Candidates:
    """Points that should be in view. rows: (n,) slot*births+index. uv: (n,2) px. warp: (n,2,2). xyz: (n,3) m.
    ray: (n,3) m, one deviation of depth. depth: (n,) m in the camera.
    """

    rows: I64
    uv: F64
    warp: F64
    xyz: F64
    ray: F64
    depth: F64


class LocalMap:
    """Keyframes and points near the vehicle, bounded in number."""

    def __init__(self, camera: RectifiedCamera, config: LocalMapConfig, filtering: DepthFilterConfig) -> None:
        k, b = config.keyframes, config.landmarks
        self.camera = camera
        self.intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.bf])
        self._size = np.array([camera.width, camera.height], np.float64)
        self._config = config
        self.searched = config.searched
        self._filtering = filtering
        self.keyframe = np.full(k, NO_KEYFRAME, np.int64)
        self.parent = np.full(k, NO_KEYFRAME, np.int64)
        self.T_m_k = np.tile(np.eye(4), (k, 1, 1))
        self.T_p_k = np.tile(np.eye(4), (k, 1, 1))
        self.from_base = np.zeros(k, np.bool_)  # the pose is the base's
        self.last_seen = np.zeros(k, np.int64)  # number of the frame that last tracked a point of the slot
        self.counts = np.zeros(k, np.int64)
        self.shared = np.zeros(k, np.int64)  # of each slot's births: the first so many are known to the base
        self.usable = np.zeros((k, b), np.bool_)
        self.seed = np.zeros((k, b), np.bool_)  # a bearing that waits for a depth from motion
        self.measured = np.zeros((k, b), np.bool_)  # the depth is the pair's own, not the base's nor motion's
        self.disparity_offset = disparity_offset.none()  # of the pair's disparities, as far as the base knows
        self.bearing = np.zeros((k, b, 2))
        self.uv = np.zeros((k, b, 2))
        self.rho = np.zeros((k, b))
        self.sigma_rho = np.zeros((k, b))
        self.octave = np.zeros(k * b, np.uint8)
        self.angle = np.zeros(k * b, np.uint8)  # in 1/256 turns
        self.descriptor = np.zeros((k * b, 32), np.uint8)
        self.templates = np.zeros((k * b, TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
        self.tried = np.zeros(k * b, np.int32)
        self.hits = np.zeros(k * b, np.int32)
        self.misses = np.zeros(k * b, np.int32)  # of a bearing: how often it was looked for in vain
        self.last_hit = np.full(k * b, -1, np.int64)  # number of the frame that last tracked the point
        self.active = SubmapId(0)  # the submap whose points are tracked
        capacity = k * b
        self._row = np.zeros(capacity, np.int64)
        self._uv = np.zeros((capacity, 2))
        self._warp = np.zeros((capacity, 2, 2))
        self._xyz = np.zeros((capacity, 3))
        self._ray = np.zeros((capacity, 3))
        self._depth = np.zeros(capacity)

    @property
    def births(self) -> int:
        """Rows a slot."""
        return self._config.landmarks

    def activate(self, submap: SubmapId) -> None:
        """Track the points of this submap from now on; those of the others stay remembered while there is room."""
        self.active = submap

    def slot_of(self, keyframe: int) -> int:
        """The slot of a keyframe, -1 when it is not remembered."""
        slot = int((self.keyframe == keyframe).argmax())
        return slot if self.keyframe[slot] == keyframe else -1

    def point_ids(self, rows: I64) -> I64:
        """Point ids (n,) of rows (n,)."""
        return np.asarray((self.keyframe[rows // self.births] << KEYPOINT_BITS) | (rows % self.births))

    def add(
        self, head: KeyframeHeader, T_m_k: F64, uv: F64, rho: F64, sigma_rho: F64, octave: NDArray[np.uint8],
        angle: NDArray[np.uint8], descriptor: NDArray[np.uint8], templates: NDArray[np.uint8], frame_number: int,
    ) -> int:  # fmt: skip
        """Remember a keyframe with its births; the slot that it got. The slot seen least recently makes room.

        uv: (n,2) px. rho, sigma_rho: (n,) 1/m; rho 0: depth unknown, the point waits for motion or the base.
        angle: (n,) in 1/256 turns. descriptor: (n,32). templates: (n,3,21,21).
        """
        slot = self._free_slot(head.parent)
        n = min(len(uv), self.births)
        rows = slice(slot * self.births, slot * self.births + n)
        self.keyframe[slot], self.parent[slot] = head.keyframe, head.parent
        self.T_m_k[slot], self.T_p_k[slot] = T_m_k, head.T_p_k
        self.from_base[slot] = False
        self.last_seen[slot] = frame_number
        self.counts[slot] = n
        self.usable[slot] = False
        self.usable[slot, :n] = rho[:n] > 0.0
        self.uv[slot, :n] = uv[:n]
        self.bearing[slot, :n] = self._bearings(uv[:n])
        self.rho[slot, :n] = np.where(rho[:n] > 0.0, rho[:n], 1.0 / _SEED_DEPTH_M)
        self.sigma_rho[slot, :n] = np.where(rho[:n] > 0.0, sigma_rho[:n], 0.0)  # 0: not planted
        self.measured[slot] = False
        self.measured[slot, :n] = rho[:n] > 0.0
        self.seed[slot] = False
        self.seed[slot, :n] = rho[:n] <= 0.0
        self.octave[rows] = octave[:n]
        self.angle[rows], self.descriptor[rows] = angle[:n], descriptor[:n]
        self.templates[rows] = templates[:n]
        self.tried[rows], self.hits[rows], self.misses[rows] = 0, 0, 0
        self.last_hit[rows] = frame_number
        return slot

    def _bearings(self, uv: F64) -> F64:
        c = self.camera
        return np.asarray((uv - np.array([c.cx, c.cy])) / np.array([c.fx, c.fy]))

    def _free_slot(self, parent: KeyframeId) -> int:
        empty = np.flatnonzero(self.keyframe == NO_KEYFRAME)
        if len(empty):
            return int(empty[0])
        age = np.where(self.keyframe == parent, np.iinfo(np.int64).max, self.last_seen)
        return int(np.argmin(age))

    def share(self, keyframe: KeyframeId, births: int) -> None:
        """The first so many births of a keyframe are shared with the base; the others stay here."""
        self.shared[self.slot_of(keyframe)] = births

    def is_shared(self, rows: I64) -> NDArray[np.bool_]:
        """Which points of rows (n,) the base knows."""
        return np.asarray(rows % self.births < self.shared[rows // self.births])

    def candidates(
        self, T_c_m: F64, margin_px: float, max_scale: float, *, seeds: bool = False, submap: SubmapId | None = None
    ) -> Candidates:
        """The usable points (or bearings) that should be in view of a camera at T_c_m (4,4).

        submap: None for the active one. Views into buffers: use them at once.
        """
        wanted = self.active if submap is None else submap
        slots = self._searched(np.flatnonzero(self.keyframe >> SEQUENCE_BITS == wanted))
        n = kernels.project(
            T_c_m, self.intrinsics, self._size, margin_px, max_scale, slots, self.T_m_k, self.counts,
            self.seed if seeds else self.usable,
            self.bearing, self.rho, self.sigma_rho, self._row, self._uv, self._warp, self._xyz, self._ray, self._depth,
        )  # fmt: skip
        return Candidates(self._row[:n], self._uv[:n], self._warp[:n], self._xyz[:n], self._ray[:n], self._depth[:n])

    def _searched(self, slots: I64) -> I64:
        """Of some slots those seen last, as many as are searched."""
        if len(slots) <= self.searched:
            return slots
        order = np.argsort(-self.last_seen[slots], kind="stable")[: self.searched]
        return np.asarray(np.sort(slots[order]))

    def update_depths(
        self, T_c_m: F64, rows: I64, inlier: NDArray[np.bool_], observed: F64, sigma_px: F64, inflate: float
    ) -> None:
        """Mend the inverse depths of rows by where they were seen from T_c_m."""
        floor = self._filtering.floor_px / self.camera.bf
        kernels.sharpen(
            T_c_m, self.intrinsics, rows, inlier, observed, sigma_px, inflate, floor,
            self.T_m_k, self.bearing, self.rho, self.sigma_rho,
        )  # fmt: skip

    def note_tracking(self, rows: I64, inlier: NDArray[np.bool_], frame_number: int) -> None:
        """Keep count of tries and hits; points that keep failing leave."""
        self.tried[rows] += 1
        good = rows[inlier]
        self.hits[good] += 1
        self.last_hit[good] = frame_number
        self.last_seen[np.unique(good // self.births)] = frame_number
        hopeless = rows[(self.tried[rows] >= 12) & (self.hits[rows] * 5 < self.tried[rows])]
        self.usable.reshape(-1)[hopeless] = False

    # bearings without depth

    def initialise_seeds(self, rho: float, sigma_rho: float) -> None:
        """Give bearings that are new a rough inverse depth in 1/m, to look around."""
        new = self.seed & (self.sigma_rho == 0.0)
        self.rho[new], self.sigma_rho[new] = rho, sigma_rho

    def promote(self, rows: I64) -> None:
        """Bearings (n,) that have a depth now become points."""
        self.seed.reshape(-1)[rows] = False
        self.usable.reshape(-1)[rows] = True
        self.tried[rows], self.hits[rows] = 0, 0

    def drop_submap(self, submap: SubmapId) -> None:
        """Drop the keyframes of a submap."""
        slots = np.flatnonzero(self.keyframe >> SEQUENCE_BITS == submap)
        self.keyframe[slots] = NO_KEYFRAME
        self.counts[slots] = 0

    # what the base made of it

    def apply(
        self, record: KeyframePose | RefinedLandmarks | FusedLandmarks | RemovedObservations | CulledLandmarks
    ) -> bool:
        """Take over one value of the base; False when its keyframe is not remembered here."""
        slot = self.slot_of(record.keyframe)
        if slot < 0:
            return False
        if isinstance(record, KeyframePose):
            self.T_m_k[slot] = record.T_m_k
            self.from_base[slot] = True
        elif isinstance(record, RefinedLandmarks):
            self._apply_depths(slot, record)
        elif isinstance(record, FusedLandmarks):
            self._apply_found(slot, record)
        else:  # removed births and culled points are no longer looked for
            index = record.index.astype(np.int64)
            self.usable[slot, index[index < self.shared[slot]]] = False
            self.seed[slot, index[index < self.shared[slot]]] = False
        return True

    def _apply_depths(self, slot: int, record: RefinedLandmarks) -> None:
        keep = (record.index < self.shared[slot]) & (record.inv_depth > 0.0)
        index = record.index[keep].astype(np.int64)
        never = ~self.usable[slot, index] & (self.tried[slot * self.births + index] == 0)
        fresh = never | self.seed[slot, index]
        self.rho[slot, index] = record.inv_depth[keep]
        self.measured[slot, index] = False
        self.sigma_rho[slot, index] = self._filtering.refined_sigma_px / self.camera.bf
        self.bearing[slot, index] = self._bearings(self.uv[slot, index] + record.offset[keep])
        self.promote(slot * self.births + index[fresh])  # points that only the base could place

    def offset_px(self, uv: F64) -> F64:
        """What the pair's disparities at pixels (n,2) are too large by (n,)."""
        return np.asarray(disparity_offset.terms(self._bearings(uv)) @ self.disparity_offset)

    def set_disparity_offset(self, offset: F64) -> None:
        """The pair's disparities are too large by an offset (5,) px (`disparity_offset`): depths it measured follow."""
        at = disparity_offset.terms(self.bearing[self.measured])
        change = at @ (offset - self.disparity_offset) / self.camera.bf
        self.disparity_offset = np.array(offset)
        least = self.camera.fx / (self.camera.bf * self._config.max_far_ratio)
        self.rho[self.measured] = np.maximum(self.rho[self.measured] - change, least)

    def _apply_found(self, slot: int, record: FusedLandmarks) -> None:
        """A birth that shows an older point leaves, where the older one is remembered."""
        for index, point in zip(record.index.tolist(), record.point.tolist()):
            if index < self.shared[slot] and self.slot_of(point >> KEYPOINT_BITS) >= 0:
                self.usable[slot, index] = point == point_id(KeyframeId(int(self.keyframe[slot])), index)
                self.seed[slot, index] &= self.usable[slot, index]

    def compose_unplaced(self) -> None:
        """Compose keyframes that the base has not placed from their parents, oldest first."""
        for slot in np.argsort(self.keyframe, kind="stable"):
            if self.keyframe[slot] == NO_KEYFRAME or self.from_base[slot] or self.parent[slot] == NO_KEYFRAME:
                continue
            parent = self.slot_of(int(self.parent[slot]))
            if parent >= 0:
                self.T_m_k[slot] = self.T_m_k[parent] @ self.T_p_k[slot]

"""The agent's local map: a bounded number of keyframes, and their landmarks with templates.

Structure of arrays of fixed capacity: slot k holds a keyframe, row k * slot_size + i the new landmark at its
keypoint i. A landmark is a bearing in its keyframe and an inverse depth, so that a corrected keyframe moves its
landmarks. Keyframes of several submaps are stored; only those of the active one are tracked.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import LocalMapConfig
from kiteline_agent.imaging.alignment_kernels import TEMPLATE, TEMPLATE_LEVELS
from kiteline_agent.local_map import projection_kernels as kernels
from kiteline_agent.local_map.held_corrections import HeldCorrections, Removed
from kiteline_agent.local_map.keyframe_landmarks import KeyframeLandmarks
from kiteline_agent.local_map.row_parallax import RowParallax
from kiteline_codec.schema import KeyframeHeader, KeyframePose, RefinedLandmarks
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry import disparity_offset, se3
from kiteline_core.geometry.cameras import RectifiedCamera, virtual_bf
from kiteline_core.ids import KEYPOINT_BITS, NO_KEYFRAME, SEQUENCE_BITS, KeyframeId, SubmapId
from kiteline_core.order_statistics import median

_SEED_DEPTH_M = 1e4  # stands for infinity in landmarks without depth
_MIN_TRIES = 12  # frames that must have searched a landmark before it is given up
_TRIES_A_HIT = 5  # frames that search a landmark for one that finds it; with more it is given up
_REFINED_SIGMA_PX = 0.08  # px: virtual disparity error of a depth that the base refined
_FLOOR_PX = 0.06  # px: smallest virtual disparity error of the filter
_MAX_SCALE = 2.5  # change of distance since the template was cut, as a factor


@dataclass(frozen=True, slots=True)
class Candidates:
    """Landmarks that should be in view. rows: (n,) slot*slot_size+index. uv: (n,2) px. warp: (n,2,2). xyz: (n,3) m.
    ray: (n,3) m, one standard deviation of depth. depth: (n,) m in the camera.
    """

    rows: I64
    uv: F64
    warp: F64
    xyz: F64
    ray: F64
    depth: F64


class LocalMap:
    """Keyframes and landmarks near the vehicle."""

    def __init__(self, camera: RectifiedCamera, config: LocalMapConfig) -> None:
        k, b = config.keyframes, config.landmarks
        self.camera = camera
        self.intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.bf])
        self._size = np.array([camera.width, camera.height], np.float64)
        self._config = config
        self.searched = config.searched
        self.keyframe = np.full(k, NO_KEYFRAME, np.int64)
        self.parent = np.full(k, NO_KEYFRAME, np.int64)
        self.T_m_k = np.tile(np.eye(4), (k, 1, 1))
        self.T_p_k = np.tile(np.eye(4), (k, 1, 1))
        self.from_base = np.zeros(k, np.bool_)  # the pose was set by the base
        self.rolled = np.zeros(k, np.bool_)  # the pixels are as a rolling shutter took them: its motion was unknown
        self.last_seen = np.zeros(k, np.int64)  # number of the frame that last tracked a landmark of the slot
        self.counts = np.zeros(k, np.int64)
        self.order = np.tile(np.arange(b), (k, 1))  # of a slot's landmarks as candidates: no link changes it
        self.shared = np.zeros(k, np.int64)  # number of landmarks in each slot that the base knows: the first ones
        self.usable = np.zeros((k, b), np.bool_)
        self.seed = np.zeros((k, b), np.bool_)  # a landmark that still has no depth
        self.removed = np.zeros((k, b), np.bool_)  # the base removed the landmark
        self.measured = np.zeros((k, b), np.bool_)  # the depth is that of stereo, not of the base or of motion
        self.disparity_offset = disparity_offset.none()  # of the stereo disparities, as base or agent estimate it
        self.disparity = np.zeros((k, b))  # px, in the keyframe itself, with the offset; 0: not measured
        self.bearing = np.zeros((k, b, 2))
        self.row_parallax = RowParallax(k, b)
        self.uv = np.zeros((k, b, 2))
        self.rho = np.zeros((k, b))
        self.sigma_rho = np.zeros((k, b))
        self.slant = np.zeros((k, b, 2))  # of the surface around a landmark: see projection_kernels.project
        self.slant_equations = np.zeros((k, b, 5))  # that determine it: xx, xy, yy, x, y
        self.octave = np.zeros(k * b, np.uint8)
        self.angle = np.zeros(k * b, np.uint8)  # in 1/256 turns
        self.descriptor = np.zeros((k * b, 32), np.uint8)
        self.templates = np.zeros((k * b, TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
        self.tried = np.zeros(k * b, np.int32)
        self.hits = np.zeros(k * b, np.int32)
        self.misses = np.zeros(k * b, np.int32)  # of a seed: searches without a match
        self.last_hit = np.full(k * b, -1, np.int64)  # number of the frame that last tracked the landmark
        self.held = HeldCorrections()
        self._has_new_seeds = False  # some may not be initialised
        self.due = False  # some of these differ by more than both maps' errors
        self.active = SubmapId(0)  # the submap that is tracked
        self.in_own_unit = False  # lengths in it are in a unit of its own, and not in metres
        capacity = k * b
        self._facing = np.zeros((k, b, 2))  # slants
        self._row = np.zeros(capacity, np.int64)
        self._uv = np.zeros((capacity, 2))
        self._warp = np.zeros((capacity, 2, 2))
        self._xyz = np.zeros((capacity, 3))
        self._ray = np.zeros((capacity, 3))
        self._depth = np.zeros(capacity)

    @property
    def slot_size(self) -> int:
        """Number of rows of a slot."""
        return self._config.landmarks

    def activate(self, submap: SubmapId) -> None:
        """Track this submap from now on; keyframes of the others stay while there is room."""
        self.active = submap

    def slot_of(self, keyframe: int) -> int:
        """The slot of a keyframe, -1 if it is not stored."""
        slot = int((self.keyframe == keyframe).argmax())
        return slot if self.keyframe[slot] == keyframe else -1

    def landmark_ids(self, rows: I64) -> I64:
        """Landmark ids (n,) of rows (n,)."""
        return np.asarray((self.keyframe[rows // self.slot_size] << KEYPOINT_BITS) | (rows % self.slot_size))

    def add(self, head: KeyframeHeader, T_m_k: F64, new: KeyframeLandmarks, frame_number: int) -> int:
        """Store a keyframe with its new landmarks, and return its slot. The slot seen least recently is evicted."""
        uv, rho = new.uv, new.rho
        slot = self._free_slot(head.parent)
        self.held.forget(KeyframeId(int(self.keyframe[slot])))
        self.held.forget_evicted(self.keyframe, self.parent)
        n = min(len(uv), self.slot_size)
        rows = slice(slot * self.slot_size, slot * self.slot_size + n)
        self.keyframe[slot], self.parent[slot] = head.keyframe, head.parent
        self.T_m_k[slot], self.T_p_k[slot] = T_m_k, head.T_p_k
        self.from_base[slot] = False
        self.last_seen[slot] = frame_number
        self.counts[slot] = n
        self.order[slot, :n] = np.arange(n) if new.order is None else new.order[new.order < n]
        self.usable[slot] = self.removed[slot] = False
        self.usable[slot, :n] = rho[:n] > 0.0
        self.uv[slot, :n] = uv[:n]
        self.bearing[slot, :n] = self._bearings(uv[:n])
        self.rho[slot, :n] = np.where(rho[:n] > 0.0, rho[:n], 1.0 / _SEED_DEPTH_M)
        self.sigma_rho[slot, :n] = np.where(rho[:n] > 0.0, new.sigma_rho[:n], 0.0)  # 0: not initialised
        self.slant[slot] = self.slant_equations[slot] = 0.0
        self.measured[slot] = False
        self.measured[slot, :n] = rho[:n] > 0.0
        self.disparity[slot] = 0.0
        self.disparity[slot, :n] = np.where(rho[:n] > 0.0, rho[:n] * self.camera.bf + self.offset_px(uv[:n]), 0.0)
        self.seed[slot] = False
        self.seed[slot, :n] = rho[:n] <= 0.0
        self._has_new_seeds = True
        self.octave[rows], self.angle[rows], self.descriptor[rows] = new.octave[:n], new.angle[:n], new.descriptor[:n]
        self.templates[rows] = new.templates[:n]
        self.tried[rows], self.hits[rows], self.misses[rows], self.last_hit[rows] = 0, 0, 0, frame_number
        return slot

    def _bearings(self, uv: F64) -> F64:
        return np.asarray((uv - self.intrinsics[2:4]) / self.intrinsics[:2])

    def _free_slot(self, parent: KeyframeId) -> int:
        empty = np.flatnonzero(self.keyframe == NO_KEYFRAME)
        if len(empty):
            return int(empty[0])
        age = np.where(self.keyframe == parent, np.iinfo(np.int64).max, self.last_seen)
        return int(np.argmin(age))

    def share(self, keyframe: KeyframeId, landmarks: int) -> None:
        """Note how many of a keyframe's landmarks, the first ones, are shared with the base."""
        self.shared[self.slot_of(keyframe)] = landmarks

    def is_shared(self, rows: I64) -> Bool:
        """Which landmarks of rows (n,) are shared with the base."""
        return np.asarray(rows % self.slot_size < self.shared[rows // self.slot_size])

    def candidates(
        self, T_c_m: F64, margin_px: float, *, seeds: bool = False, facing: bool = False, submap: SubmapId | None = None
    ) -> Candidates:
        """The usable landmarks (or seeds) that should be in view of a camera at T_c_m (4,4).

        facing: as if surfaces faced their keyframes. submap: None for the active one. Views into buffers: use at once.
        """
        wanted = self.active if submap is None else submap
        slots = self._searched((self.keyframe >> SEQUENCE_BITS == wanted).nonzero()[0])
        n = kernels.project(
            T_c_m, self.intrinsics, self._size, margin_px, _MAX_SCALE, slots, self.T_m_k, self.order, self.counts,
            self.seed if seeds else self.usable, self.bearing, self.rho, self._facing if facing else self.slant,
            self.sigma_rho, self._row, self._uv, self._warp, self._xyz, self._ray, self._depth,
        )  # fmt: skip
        return Candidates(self._row[:n], self._uv[:n], self._warp[:n], self._xyz[:n], self._ray[:n], self._depth[:n])

    def _searched(self, slots: I64) -> I64:
        """Of some slots those seen last, as many as the governor allows."""
        if len(slots) <= self.searched:
            return slots
        order = np.argsort(-self.last_seen[slots], kind="stable")[: self.searched]
        return np.asarray(np.sort(slots[order]))

    def positions(self, rows: I64) -> tuple[F64, F64]:
        """Positions (n,3) m in the submap of landmarks in rows (n,), and one deviation of depth as a vector (n,3) m."""
        T, rho = self.T_m_k.take(rows // self.slot_size, 0), self.rho.take(rows)
        ray = np.einsum("nij,nj->ni", T[:, :3, :2], self.bearing.reshape(-1, 2).take(rows, 0)) + T[:, :3, 2]
        far = self.sigma_rho.take(rows) / rho**2  # d(1/rho) = d(rho) / rho^2
        return T[:, :3, 3] + ray / rho[:, None], ray * far[:, None]

    def update_depths(self, T_c_m: F64, rows: I64, inlier: Bool, observed: F64, sigma_px: F64, inflate: float) -> None:
        """Update the inverse depths of rows (n,) by observations (n,3) from T_c_m (4,4)."""
        floor = _FLOOR_PX / self.camera.bf
        kernels.update_depths(
            T_c_m, self.intrinsics, rows, inlier, observed, sigma_px, inflate, floor,
            self.T_m_k, self.bearing, self.rho, self.sigma_rho,
        )  # fmt: skip

    def follow_depths(self, rows: I64) -> None:
        """Move landmarks of rolling-shutter keyframes, rows (n,), to where their new depths put them at the stamps."""
        if self.row_parallax.any:
            change = self.row_parallax.change(rows, self.rho.take(rows))
            self.bearing.reshape(-1, 2)[rows] += change
            self.uv.reshape(-1, 2)[rows] += change * self.intrinsics[:2]

    def note_tracking(self, rows: I64, inlier: Bool, frame_number: int) -> None:
        """Count tries and hits; landmarks that keep failing are no longer searched."""
        self.tried[rows] += 1
        good = rows[inlier]
        self.hits[good] += 1
        self.last_hit[good] = frame_number
        self.last_seen[good // self.slot_size] = frame_number
        hopeless = rows[(self.tried[rows] >= _MIN_TRIES) & (self.hits[rows] * _TRIES_A_HIT < self.tried[rows])]
        self.usable.reshape(-1)[hopeless] = False

    # landmarks without depth (seeds)

    def initialise_seeds(self, rho: float, sigma_rho: float) -> None:
        """Give new seeds an inverse depth and its deviation in 1/m, which bound the search."""
        if self._has_new_seeds:
            new = self.seed & (self.sigma_rho == 0.0)
            self.rho[new], self.sigma_rho[new] = rho, sigma_rho
            self._has_new_seeds = False

    def promote(self, rows: I64) -> None:
        """Make landmarks of seeds, rows (n,), whose depth is known now."""
        self.seed.reshape(-1)[rows] = False
        self.usable.reshape(-1)[rows] = True
        self.tried[rows], self.hits[rows] = 0, 0

    def drop_submap(self, submap: SubmapId) -> None:
        """Drop the keyframes of a submap."""
        slots = np.flatnonzero(self.keyframe >> SEQUENCE_BITS == submap)
        for keyframe in self.keyframe[slots].tolist():
            self.held.forget(KeyframeId(keyframe))
        self.keyframe[slots] = NO_KEYFRAME
        self.counts[slots] = 0

    def drop_within(self, cells: Bool, cell_px: int) -> None:
        """Drop the landmarks whose own keyframe shows them in these cells (rows, columns) of the image, for good."""
        row, column = (np.minimum(self.uv[..., k] // cell_px, cells.shape[1 - k] - 1).astype(np.int64) for k in (1, 0))
        gone = cells[row, column]
        self.usable[gone], self.seed[gone], self.removed[gone] = False, False, True

    # records of the base

    def set_pose(self, record: KeyframePose) -> None:
        """Hold a keyframe's pose ready for `apply_corrections`."""
        slot = self.slot_of(record.keyframe)
        self.held.set_pose(record.keyframe, record.T_m_k, stored=slot >= 0)
        if slot >= 0:
            self.due |= self._shift_px(slot, record.T_m_k) >= self._config.moved_px

    def apply_corrections(self) -> bool:
        """Take over all poses and landmarks that the base sent, if those of a keyframe move far enough.

        Smaller differences are within the errors of both maps; taken over one by one, they disturb a map that the
        frames of this agent keep consistent. Returns True if the map moved.
        """
        if not self.due:
            return False
        self.try_corrections(self.held.landmarks.keys())
        for keyframe, landmarks in self.held.landmarks.items():
            self._add_fresh(self.slot_of(keyframe), *landmarks)
        for record in self.held.removed.values():
            self._drop(record)
        self.held.clear()
        self.due = False
        return True

    def try_corrections(self, keyframes: Collection[KeyframeId]) -> None:
        """Take over the poses that the base sent, and tracked landmarks of some keyframes; all of them still wait."""
        slots = self._slots()
        for keyframe, T_m_k in self.held.poses.items():
            if keyframe in slots:
                self.T_m_k[slots[keyframe]] = T_m_k
                self.from_base[slots[keyframe]] = True
        for keyframe, (index, rho, bearing) in self.held.landmarks.items():
            if keyframe in keyframes and keyframe in slots:
                known = ~self._is_fresh(slots[keyframe], index)
                self._set_landmarks(slots[keyframe], index[known], rho[known], bearing[known])

    def _slots(self) -> dict[int, int]:
        """Slots by keyframe."""
        return {keyframe: slot for slot, keyframe in enumerate(self.keyframe.tolist())}

    def _corrected(self) -> tuple[NDArray[Any], ...]:
        """What `try_corrections` changes."""
        return self.T_m_k, self.from_base, self.rho, self.bearing, self.measured, self.sigma_rho

    def save(self) -> tuple[NDArray[Any], ...]:
        """The map before `try_corrections`."""
        return tuple(a.copy() for a in self._corrected())

    def restore(self, saved: tuple[NDArray[Any], ...]) -> None:
        """Undo `try_corrections`."""
        for array, before in zip(self._corrected(), saved, strict=True):
            array[...] = before

    def _shift_px(self, slot: int, T_m_k: F64) -> float:
        """By how much landmarks at the keyframe's typical depth move in its image if its pose is set to T_m_k (4,4)."""
        shift_m, turn = se3.shift_and_turn(se3.inverse(self.T_m_k[slot]) @ T_m_k)
        rho = self.rho[slot, self.usable[slot]]
        return float(self.camera.fx * (shift_m * (median(rho) if len(rho) else 0.0) + turn))

    def remove(self, record: Removed) -> None:
        """Hold landmarks that the base removed ready for `apply_corrections`: they are searched for until then."""
        if self.slot_of(record.keyframe) >= 0:
            self.held.removed[record.keyframe, record.KIND] = record

    def _drop(self, record: Removed) -> None:
        """Stop searching for landmarks that the base removed."""
        slot = self.slot_of(record.keyframe)
        if slot < 0:
            return
        index = record.index[record.index < self.shared[slot]].astype(np.int64)
        self.usable[slot, index] = self.seed[slot, index] = False
        self.removed[slot, index] = True

    def refine(self, record: RefinedLandmarks) -> None:
        """Hold refined landmarks ready for `apply_corrections`."""
        slot = self.slot_of(record.keyframe)
        if slot < 0:
            return
        keep = (record.index < self.shared[slot]) & (record.inv_depth > 0.0)
        index = record.index[keep].astype(np.int64)
        rho = record.inv_depth[keep].astype(np.float64)
        bearing = self._bearings(self.uv[slot, index] + record.offset[keep])
        self.held.landmarks.pop(record.keyframe, None)  # older ones, that waited
        if len(index):
            self.held.set_landmarks(record.keyframe, index, rho, bearing)
            turned = np.hypot(*(bearing - self.bearing[slot, index]).T) * self.camera.fx
            nearer = np.abs(rho - self.rho[slot, index]) * self._virtual_bf(slot)
            px = np.maximum(turned, nearer)[~self._is_fresh(slot, index)]
            self.due |= len(px) > 0 and median(px) >= self._config.moved_px

    def _is_fresh(self, slot: int, index: I64) -> Bool:
        """Which landmarks of a slot have no depth of their own: only the base could triangulate them.

        The base refines landmarks that others observe even where it has removed the one of this keyframe.
        """
        never = ~self.usable[slot, index] & (self.tried[slot * self.slot_size + index] == 0)
        return np.asarray((never | self.seed[slot, index]) & ~self.removed[slot, index])

    def _add_fresh(self, slot: int, index: I64, rho: F64, bearing: F64) -> None:
        """Track those of a slot's landmarks from now on that only the base could triangulate."""
        fresh = self._is_fresh(slot, index)
        self._set_landmarks(slot, index[fresh], rho[fresh], bearing[fresh])
        self.promote(slot * self.slot_size + index[fresh])

    def _set_landmarks(self, slot: int, index: I64, rho: F64, bearing: F64) -> None:
        self.rho[slot, index], self.bearing[slot, index] = rho, bearing
        self.row_parallax.refer(slot, index, rho)
        self.measured[slot, index] = False
        self.sigma_rho[slot, index] = _REFINED_SIGMA_PX / self._virtual_bf(slot)

    def _virtual_bf(self, slot: int) -> float:
        """Focal length in px times baseline, by which depths in a keyframe are compared in px of disparity.

        In metres that of the camera; in a unit of its own see `virtual_bf`.
        """
        rho = self.rho[slot, self.usable[slot]] if self.in_own_unit else np.zeros(0)
        return virtual_bf(self.camera.bf, rho) if len(rho) else self.camera.bf

    def offset_px(self, uv: F64) -> F64:
        """Error (n,) of stereo disparities at pixels (n,2)."""
        return np.asarray(disparity_offset.terms(self._bearings(uv)) @ self.disparity_offset)

    def set_disparity_offset(self, offset: F64) -> None:
        """Set the error of stereo disparities (5,) px (`disparity_offset`); correct the depths measured by stereo."""
        change = disparity_offset.terms(self.bearing[self.measured]) @ (offset - self.disparity_offset) / self.camera.bf
        self.disparity_offset = np.array(offset)
        self.rho[self.measured] = np.maximum(self.rho[self.measured] - change, self.least_rho)

    @property
    def least_rho(self) -> float:
        """Smallest inverse depth, 1/m, that stereo measures."""
        return self.camera.fx / (self.camera.bf * self._config.max_far_ratio)

    def relate_to_parents(self) -> None:
        """Set the poses of keyframes relative to their parents from those in the submap."""
        for slot in np.flatnonzero((self.keyframe != NO_KEYFRAME) & (self.parent != NO_KEYFRAME)):
            if (parent := self.slot_of(int(self.parent[slot]))) >= 0:
                self.T_p_k[slot] = se3.orthonormalise(se3.inverse(self.T_m_k[parent]) @ self.T_m_k[slot])

    def compose_unplaced(self) -> None:
        """Compose the poses of keyframes that the base has not set from those of their parents, oldest first."""
        slots = self._slots()
        slots.pop(NO_KEYFRAME, None)
        parents, from_base = self.parent.tolist(), self.from_base.tolist()
        for _, slot in sorted(slots.items()):
            parent = None if from_base[slot] else slots.get(parents[slot])
            if parent is not None:
                self.T_m_k[slot] = self.T_m_k[parent] @ self.T_p_k[slot]

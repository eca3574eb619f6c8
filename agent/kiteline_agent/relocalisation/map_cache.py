"""What the base lends: copies of keyframes that others saw or that this agent forgot, for the place where it is.

A copy has points and descriptors but no image, so nothing can be aligned with it. Its points are met by the corners of
a frame instead: of a lost one, which is thereby found again, and of each new keyframe, whose points then take over the
copy's depth, and which moves a little towards where the copies say that it is. So the agent flies in the lent map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import MapCacheConfig
from kiteline_agent.keyframes.policy import NewPoints
from kiteline_agent.local_map import projection_kernels as kernels
from kiteline_codec.schema import CachedKeyframe, CachedLandmarks, Key
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId
from kiteline_core.imaging.descriptors import comparable
from kiteline_core.imaging.matching import MatchConfig, Matches, match, match_near
from kiteline_core.places.place_index import PlaceIndex, Vocabulary
from kiteline_core.pose.pnp import RansacConfig, solve_pnp
from kiteline_core.pose.pose_kernels import optimise_pose

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

_MARGIN_PX = 4.0  # beyond the border: a point that is just out of view has no corner


@dataclass(frozen=True, slots=True)
class FrameFeatures:
    """Corners of a frame. uv: (n,2) px. disparity: (n,) px, < 0 none. octave, angle: (n,). descriptor: (n,32)."""

    uv: F64
    disparity: F64
    octave: U8
    angle: U8
    descriptor: U8


@dataclass(frozen=True, slots=True)
class CacheMatches:
    """Lent points that corners met. T_c_m: (4,4) by them alone. corner: (n,) indices of corners. depth_m: (n,) in the
    camera. xyz, ray, observed, sigma_px: (n,3), (n,3), (n,3), (n,) as in `optimise_pose`. foreseen: how many points
    should have been in view.
    """

    T_c_m: F64
    corner: I64
    depth_m: F64
    xyz: F64
    ray: F64
    observed: F64
    sigma_px: F64
    foreseen: int


@dataclass(frozen=True, slots=True)
class _Around:
    """Lent points foreseen in a view: rows, pixels, octaves as they should look, and where they are."""

    rows: I64
    uv: F64
    octave: F64
    xyz: F64
    ray: F64


class MapCache:
    """The copies, bounded in number: slot k holds a keyframe, row k * points + i one of its points."""

    def __init__(
        self, camera: RectifiedCamera, config: MapCacheConfig, matching: MatchConfig, ransac: RansacConfig,
        words: Vocabulary | None,
    ) -> None:  # fmt: skip
        k, p = config.copies, config.points
        self._camera = camera
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.bf])
        self._size = np.array([camera.width, camera.height], np.float64)
        self._config = config
        self._matching = matching
        self._ransac = ransac
        self._words = words
        self._index: PlaceIndex | None = None  # made when something is looked for
        self._indexed: set[int] = set()
        self.keyframe = np.full(k, NO_KEYFRAME, np.int64)
        self._submap = np.full(k, -1, np.int64)  # in which the pose stands; -1: none has come
        self._T_m_k = np.tile(np.eye(4), (k, 1, 1))
        self._counts = np.zeros(k, np.int64)
        self._touched = np.zeros(k, np.int64)  # when a copy last came or was told of
        self._clock = 0
        self._parts: list[dict[int, CachedLandmarks]] = [{} for _ in range(k)]
        self._usable = np.zeros((k, p), np.bool_)
        self._bearing = np.zeros((k, p, 2))
        self._rho = np.zeros((k, p))
        self._sigma_rho = np.zeros((k, p))
        self._octave = np.zeros(k * p, np.uint8)
        self._angle = np.zeros(k * p, np.uint8)
        self._descriptor = np.zeros((k * p, 32), np.uint8)
        n = k * p
        self._out = (
            np.zeros(n, np.int64), np.zeros((n, 2)), np.zeros((n, 2, 2)), np.zeros((n, 3)), np.zeros((n, 3)),
            np.zeros(n),
        )  # fmt: skip

    def __len__(self) -> int:
        return int(np.count_nonzero(self.keyframe != NO_KEYFRAME))

    def lies_in(self, submap: SubmapId) -> bool:
        """Whether any copy can be used in a submap."""
        return bool((self._submap == submap).any())

    # what the base sends

    def take(self, record: CachedKeyframe | CachedLandmarks) -> None:
        """A copy's pose, or some of its points."""
        slot = self._slot(record.keyframe)
        self._clock += 1
        self._touched[slot] = self._clock
        if isinstance(record, CachedKeyframe):
            self._submap[slot] = record.submap
            self._T_m_k[slot] = record.T_m_k
            return
        self._parts[slot][record.part] = record
        self._fill(slot)

    def take_back(self, keys: Sequence[Key]) -> None:
        """Copies that the base wants back."""
        for key in keys:
            if key.kind == CachedKeyframe.KIND:
                for slot in np.flatnonzero(self.keyframe == key.id).tolist():
                    self._clear(slot)

    def _slot(self, keyframe: KeyframeId) -> int:
        held = np.flatnonzero(self.keyframe == keyframe)
        if len(held):
            return int(held[0])
        empty = np.flatnonzero(self.keyframe == NO_KEYFRAME)
        slot = int(empty[0]) if len(empty) else int(np.argmin(self._touched))
        self._clear(slot)
        self.keyframe[slot] = keyframe
        return slot

    def _clear(self, slot: int) -> None:
        self._forget_place(slot)
        self.keyframe[slot] = NO_KEYFRAME
        self._submap[slot] = -1
        self._counts[slot] = 0
        self._parts[slot].clear()

    def _fill(self, slot: int) -> None:
        """The points of all parts that came, as far as there is room."""
        self._forget_place(slot)
        parts = [self._parts[slot][k] for k in sorted(self._parts[slot])]
        keep = np.flatnonzero(np.concatenate([part.inv_depth for part in parts]) > 0.0)[: self._config.points]
        n, c = len(keep), self._camera
        rows = slice(slot * self._config.points, slot * self._config.points + n)
        uv = np.concatenate([part.uv for part in parts]).astype(np.float64)[keep]
        self._bearing[slot, :n] = (uv - (c.cx, c.cy)) / (c.fx, c.fy)
        self._rho[slot, :n] = np.concatenate([part.inv_depth for part in parts])[keep]
        self._sigma_rho[slot, :n] = self._config.sigma_px / c.bf
        self._usable[slot] = False
        self._usable[slot, :n] = True
        self._counts[slot] = n
        self._octave[rows] = np.concatenate([part.octave for part in parts])[keep]
        self._angle[rows] = np.concatenate([part.angle for part in parts])[keep]
        self._descriptor[rows] = np.concatenate([part.descriptor for part in parts])[keep]

    # meeting them

    def meet(self, T_c_m: F64, submap: SubmapId, seen: FrameFeatures, radius_px: float) -> CacheMatches | None:
        """Lent points of a submap that corners of a frame at about T_c_m (4,4) show; None where too few agree."""
        around = self._around(T_c_m, submap, _MARGIN_PX)
        if len(around.rows) < self._config.min_met or len(seen.uv) < self._config.min_met:
            return None
        offered, wanted = comparable(seen.descriptor, self._descriptor[around.rows])
        found = match_near(
            around.uv, np.full(len(around.rows), radius_px), around.octave, wanted, seen.uv, seen.octave, offered,
            (self._camera.width, self._camera.height), self._config.octave_gap, self._matching,
        )  # fmt: skip
        return self._agreed(T_c_m, around, found, seen)

    def _agreed(self, T_c_m: F64, around: _Around, found: Matches, seen: FrameFeatures) -> CacheMatches | None:
        """What of the matches one pose explains."""
        if len(found.a) < self._config.min_met:
            return None
        xyz, ray = around.xyz[found.a], around.ray[found.a]
        observed = np.column_stack([seen.uv[found.b], seen.disparity[found.b]])
        sigma_px = self._config.corner_px * np.ldexp(1.0, seen.octave[found.b].astype(np.int32))
        T, inlier = T_c_m.copy(), np.ones(len(found.a), np.bool_)
        inliers, _ = optimise_pose(
            T, xyz, ray, observed, sigma_px, self._intrinsics, T_c_m.copy(), np.zeros(6), 3, 4, self._ransac.chi2,
            inlier, np.zeros((6, 6)),
        )  # fmt: skip
        if inliers < self._config.min_met or not np.isfinite(T).all():
            return None
        T = se3.orthonormalise(T)
        depth = se3.transform(T, xyz[inlier])[:, 2]
        return CacheMatches(
            T, found.b[inlier].astype(np.int64), depth, xyz[inlier], ray[inlier], observed[inlier], sigma_px[inlier],
            len(around.rows),
        )  # fmt: skip

    def yields(self, T_c_m: F64, met: CacheMatches) -> F64 | None:
        """T_c_m (4,4) as far towards where the copies say that it is as they know better than the track does; None
        where they are few, or far from it.
        """
        config, n = self._config, len(met.corner)
        if n < config.min_hold:
            return None
        doubt = np.repeat([config.doubt_depth * float(np.median(met.depth_m)), config.doubt_rad], 3)
        T = T_c_m.copy()
        optimise_pose(
            T, met.xyz, met.ray, met.observed, met.sigma_px, self._intrinsics, T_c_m, doubt**-2.0, 1, 4,
            self._ransac.chi2, np.ones(n, np.bool_), np.zeros((6, 6)),
        )  # fmt: skip
        before, after = (se3.transform(pose, met.xyz) for pose in (T_c_m, T))
        if not np.isfinite(T).all() or after[:, 2].min() <= 0.0:
            return None
        moved_px = self._camera.fx * np.linalg.norm(after[:, :2] / after[:, 2:] - before[:, :2] / before[:, 2:], axis=1)
        return se3.orthonormalise(T) if float(np.median(moved_px)) <= config.hold_px else None

    def _around(self, T_c_m: F64, submap: SubmapId, margin_px: float) -> _Around:
        slots = np.flatnonzero(self._submap == submap)
        row, uv, warp, xyz, ray, depth = self._out
        n = kernels.project(
            T_c_m, self._intrinsics, self._size, margin_px, self._config.max_scale, slots, self._T_m_k, self._counts,
            self._usable, self._bearing, self._rho, self._sigma_rho, row, uv, warp, xyz, ray, depth,
        )  # fmt: skip
        rows = row[:n].copy()
        nearer = np.log2(1.0 / (self._rho.reshape(-1)[rows] * depth[:n]))
        octave = self._octave[rows].astype(np.float64) + nearer
        return _Around(rows, uv[:n].copy(), octave, xyz[:n].copy(), ray[:n].copy())

    # a lost frame

    def find(self, seen: FrameFeatures, submaps: set[int], frame_number: int) -> tuple[SubmapId, CacheMatches] | None:
        """Where a frame was taken, in one of some submaps, by the lent keyframes that look most alike."""
        if self._words is None or not np.isin(self._submap, sorted(submaps)).any():
            return None
        self._fill_index()
        assert self._index is not None
        out = [int(k) for k, s in zip(self.keyframe.tolist(), self._submap.tolist()) if s not in submaps]
        for key in self._index.query(seen.descriptor, out, self._config.candidates).keys.tolist():
            slot = int(np.flatnonzero(self.keyframe == key)[0])
            submap = SubmapId(int(self._submap[slot]))
            T_c_m = self._pose_by(slot, submap, seen, frame_number)
            met = None if T_c_m is None else self.meet(T_c_m, submap, seen, self._config.radius_px)
            if met is not None and len(met.corner) >= max(
                self._config.min_found, self._config.min_share * met.foreseen
            ):
                return submap, met
        return None

    def _pose_by(self, slot: int, submap: SubmapId, seen: FrameFeatures, frame_number: int) -> F64 | None:
        """Match with all that a lent keyframe should see, and solve for the pose."""
        around = self._around(se3.inverse(self._T_m_k[slot]), submap, -self._config.beyond_px)
        wanted, offered = comparable(self._descriptor[around.rows], seen.descriptor)
        found = match(wanted, self._angle[around.rows], offered, seen.angle, self._matching)
        if len(found.a) < self._config.min_met:
            return None
        observed = np.column_stack([seen.uv[found.b], np.full(len(found.b), -1.0)])
        fit = solve_pnp(
            around.xyz[found.a], around.ray[found.a], observed, seen.octave[found.b], self._intrinsics, frame_number,
            self._ransac,
        )  # fmt: skip
        return None if fit is None or fit.inliers < self._config.min_met else fit.T_c_m

    def _fill_index(self) -> None:
        """Enter the copies that came since the last search: most flights never search."""
        assert self._words is not None
        if self._index is None:
            self._index = PlaceIndex(self._words)
        for slot in np.flatnonzero(self._submap >= 0).tolist():
            key = int(self.keyframe[slot])
            if key not in self._indexed:
                around = self._around(se3.inverse(self._T_m_k[slot]), SubmapId(int(self._submap[slot])), 0.0)
                self._index.add(key, self._descriptor[around.rows])
                self._indexed.add(key)

    def _forget_place(self, slot: int) -> None:
        key = int(self.keyframe[slot])
        if key in self._indexed and self._index is not None:
            self._index.remove(key)
            self._indexed.discard(key)


def corners_of(points: NewPoints) -> FrameFeatures:
    """The corners of a keyframe that is being made."""
    return FrameFeatures(points.uv, points.disparity, points.octave, points.angle, points.descriptor)


def with_depths(points: NewPoints, met: CacheMatches) -> NewPoints:
    """The same points; those that met lent ones know their depths."""
    rho = np.zeros(len(points.uv))
    rho[met.corner] = 1.0 / met.depth_m
    return replace(points, lent_rho=rho)

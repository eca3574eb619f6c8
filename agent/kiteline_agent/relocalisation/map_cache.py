"""Cache of keyframes sent by the base: seen by other agents, or evicted here.

They have landmarks and descriptors but no image, so a lost frame is matched with them by descriptor.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kiteline_agent.config import MapCacheConfig
from kiteline_agent.local_map import projection_kernels
from kiteline_agent.relocalisation.frame_features import FrameFeatures
from kiteline_codec.schema import CachedKeyframe, CachedLandmarks, Key
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera, virtual_bf
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId
from kiteline_core.imaging.descriptors import comparable
from kiteline_core.imaging.matching import Matches, match, match_near
from kiteline_core.places.place_index import PlaceIndex, Vocabulary
from kiteline_core.pose.pnp import PIXEL_CHI2, solve_pnp
from kiteline_core.pose.pose_kernels import optimise_pose

_MARGIN_PX = 4.0  # px beyond the border: landmarks just out of view have no corner
_NO_SUBMAP = -1  # in the array of submaps: the keyframe's pose has not arrived
_MAX_SCALE = 2.5  # change of distance since the cached keyframe, as a factor
_OCTAVE_GAP = 1.2  # octaves between predicted and matched size
_CORNER_PX = 1.0  # px at octave 0: standard deviation of a corner that was detected twice
_MIN_MATCHES = 12  # matches that agree with one pose; chance matches reach 8
_MIN_RELOCALISATION_MATCHES = 30  # the same with which a lost frame is relocalised
_MIN_SHARE = 0.15  # of the landmarks that should be in view; not every one is a corner again
_LANDMARKS = 128  # of a cached keyframe


@dataclass(frozen=True, slots=True)
class CacheMatches:
    """Cached landmarks matched with corners of a frame, and the pose from them alone.

    T_c_m: (4,4). corner: (n,) indices of corners. depth_m: (n,) in the camera. in_view: number of cached landmarks that
    should be in view.
    """

    T_c_m: F64
    corner: I64
    depth_m: F64
    in_view: int


@dataclass(frozen=True, slots=True)
class _Projections:
    """Cached landmarks projected into a camera.

    rows: (n,). uv: (n,2) px. octave: (n,), predicted. xyz, ray: (n,3) m.
    """

    rows: I64
    uv: F64
    octave: F64
    xyz: F64
    ray: F64


class MapCache:
    """Cached keyframes, bounded in number: slot k holds a keyframe, row k * landmarks + i one of its landmarks."""

    def __init__(
        self, camera: RectifiedCamera, config: MapCacheConfig,
        vocabulary: Vocabulary | None,
    ) -> None:  # fmt: skip
        k, p = config.keyframes, _LANDMARKS
        self._camera = camera
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.bf])
        self._size = np.array([camera.width, camera.height], np.float64)
        self._config = config
        self._margin_px = float(round(config.margin * camera.width))
        self._vocabulary = vocabulary
        self._index: PlaceIndex | None = None  # filled at the first search
        self._indexed: set[int] = set()
        self.keyframe = np.full(k, NO_KEYFRAME, np.int64)
        self._submap = np.full(k, _NO_SUBMAP, np.int64)  # to which the pose refers
        self._T_m_k = np.tile(np.eye(4), (k, 1, 1))
        self._order = np.tile(np.arange(p), (k, 1))
        self._counts = np.zeros(k, np.int64)
        self._touched = np.zeros(k, np.int64)  # value of _clock at the last record
        self._clock = 0
        self._parts: list[dict[int, CachedLandmarks]] = [{} for _ in range(k)]
        self._usable = np.zeros((k, p), np.bool_)
        self._bearing = np.zeros((k, p, 2))
        self._rho = np.zeros((k, p))
        self._sigma_rho = np.zeros((k, p))
        self._slant = np.zeros((k, p, 2))  # unknown: no template is warped by it
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

    def store(self, record: CachedKeyframe | CachedLandmarks) -> None:
        """Take over the pose of a cached keyframe, or some of its landmarks."""
        slot = self._slot(record.keyframe)
        self._clock += 1
        self._touched[slot] = self._clock
        if isinstance(record, CachedKeyframe):
            self._submap[slot] = record.submap
            self._T_m_k[slot] = record.T_m_k
        else:
            self._parts[slot][record.part] = record
            self._fill(slot)

    def remove(self, keys: Sequence[Key]) -> None:
        """Drop the cached keyframes that the base removed."""
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
        self._remove_from_index(slot)
        self.keyframe[slot] = NO_KEYFRAME
        self._submap[slot] = _NO_SUBMAP
        self._counts[slot] = 0
        self._parts[slot].clear()

    def _fill(self, slot: int) -> None:
        """Store the landmarks of all parts that arrived, up to the capacity."""
        self._remove_from_index(slot)
        parts = [self._parts[slot][k] for k in sorted(self._parts[slot])]
        keep = np.flatnonzero(np.concatenate([part.inv_depth for part in parts]) > 0.0)[:_LANDMARKS]
        n, c = len(keep), self._camera
        rows = slice(slot * _LANDMARKS, slot * _LANDMARKS + n)
        uv = np.concatenate([part.uv for part in parts]).astype(np.float64)[keep]
        self._bearing[slot, :n] = (uv - (c.cx, c.cy)) / (c.fx, c.fy)
        self._rho[slot, :n] = np.concatenate([part.inv_depth for part in parts])[keep]
        # without a right image lengths may be in any unit: errors are a share of the scene's depth
        bf = c.bf if c.stereo or not n else virtual_bf(c.bf, self._rho[slot, :n])
        self._sigma_rho[slot, :n] = self._config.sigma_px / bf
        self._usable[slot] = False
        self._usable[slot, :n] = True
        self._counts[slot] = n
        self._octave[rows] = np.concatenate([part.octave for part in parts])[keep]
        self._angle[rows] = np.concatenate([part.angle for part in parts])[keep]
        self._descriptor[rows] = np.concatenate([part.descriptor for part in parts])[keep]

    def match_landmarks(self, T_c_m: F64, submap: SubmapId, seen: FrameFeatures) -> CacheMatches | None:
        """Match cached landmarks of a submap with a frame at about T_c_m (4,4); None if too few agree on a pose."""
        projected = self._project(T_c_m, submap, _MARGIN_PX)
        if len(projected.rows) < _MIN_MATCHES or len(seen.uv) < _MIN_MATCHES:
            return None
        offered, wanted = comparable(seen.descriptor, self._descriptor[projected.rows])
        found = match_near(
            projected.uv, np.full(len(projected.rows), self._config.radius_px), projected.octave, wanted,
            seen.uv, seen.octave, offered, (self._camera.width, self._camera.height), _OCTAVE_GAP,
        )  # fmt: skip
        return self._consistent(T_c_m, projected, found, seen)

    def _consistent(
        self, T_c_m: F64, projected: _Projections, found: Matches, seen: FrameFeatures
    ) -> CacheMatches | None:
        """The matches that agree with one pose."""
        if len(found.a) < _MIN_MATCHES:
            return None
        xyz, ray = projected.xyz[found.a], projected.ray[found.a]
        observed = np.column_stack([seen.uv[found.b], np.full(len(found.b), -1.0)])
        sigma_px = _CORNER_PX * np.ldexp(1.0, seen.octave[found.b].astype(np.int32))
        T, inlier = T_c_m.copy(), np.ones(len(found.a), np.bool_)
        inliers, _ = optimise_pose(T, xyz, ray, observed, sigma_px, self._intrinsics, 3, 4, PIXEL_CHI2, inlier)
        if inliers < _MIN_MATCHES or not np.isfinite(T).all():
            return None
        T = se3.orthonormalise(T)
        depth = se3.transform(T, xyz[inlier])[:, 2]
        return CacheMatches(T, found.b[inlier].astype(np.int64), depth, len(projected.rows))

    def _project(self, T_c_m: F64, submap: SubmapId, margin_px: float) -> _Projections:
        slots = np.flatnonzero(self._submap == submap)
        row, uv, warp, xyz, ray, depth = self._out
        n = projection_kernels.project(
            T_c_m, self._intrinsics, self._size, margin_px, _MAX_SCALE, slots, self._T_m_k, self._order,
            self._counts, self._usable, self._bearing, self._rho, self._slant, self._sigma_rho, row, uv, warp, xyz, ray,
            depth,
        )  # fmt: skip
        rows = row[:n].copy()
        nearer = np.log2(1.0 / (self._rho.reshape(-1)[rows] * depth[:n]))
        octave = self._octave[rows].astype(np.float64) + nearer
        return _Projections(rows, uv[:n].copy(), octave, xyz[:n].copy(), ray[:n].copy())

    def find(self, seen: FrameFeatures, submaps: set[int], frame_number: int) -> tuple[SubmapId, CacheMatches] | None:
        """Relocalise a frame in one of some submaps by the most similar cached keyframes."""
        if self._vocabulary is None or not np.isin(self._submap, sorted(submaps)).any():
            return None
        self._fill_index()
        assert self._index is not None
        out = [int(k) for k, s in zip(self.keyframe.tolist(), self._submap.tolist()) if s not in submaps]
        for key in self._index.query(seen.descriptor, out, self._config.candidates).keys.tolist():
            slot = int(np.flatnonzero(self.keyframe == key)[0])
            submap = SubmapId(int(self._submap[slot]))
            T_c_m = self._pose_from(slot, submap, seen, frame_number)
            matches = None if T_c_m is None else self.match_landmarks(T_c_m, submap, seen)
            if matches is not None and len(matches.corner) >= max(
                _MIN_RELOCALISATION_MATCHES, _MIN_SHARE * matches.in_view
            ):
                return submap, matches
        return None

    def _pose_from(self, slot: int, submap: SubmapId, seen: FrameFeatures, frame_number: int) -> F64 | None:
        """P3P on matches with the landmarks in view of a cached keyframe, or a little beyond its border."""
        projected = self._project(se3.inverse(self._T_m_k[slot]), submap, -self._margin_px)
        wanted, offered = comparable(self._descriptor[projected.rows], seen.descriptor)
        found = match(wanted, self._angle[projected.rows], offered, seen.angle)
        if len(found.a) < _MIN_MATCHES:
            return None
        observed = np.column_stack([seen.uv[found.b], np.full(len(found.b), -1.0)])
        fit = solve_pnp(
            projected.xyz[found.a], projected.ray[found.a], observed, seen.octave[found.b], self._intrinsics,
            frame_number,
        )  # fmt: skip
        return None if fit is None or fit.inliers < _MIN_MATCHES else fit.T_c_m

    def _fill_index(self) -> None:
        """Index the cached keyframes that arrived since the last search; most flights never search."""
        assert self._vocabulary is not None
        if self._index is None:
            self._index = PlaceIndex(self._vocabulary)
        for slot in np.flatnonzero(self._submap != _NO_SUBMAP).tolist():
            key = int(self.keyframe[slot])
            if key not in self._indexed:
                projected = self._project(se3.inverse(self._T_m_k[slot]), SubmapId(int(self._submap[slot])), 0.0)
                self._index.add(key, self._descriptor[projected.rows])
                self._indexed.add(key)

    def _remove_from_index(self, slot: int) -> None:
        key = int(self.keyframe[slot])
        if key in self._indexed and self._index is not None:
            self._index.remove(key)
            self._indexed.discard(key)

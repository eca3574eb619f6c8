"""New landmarks of a monocular map in metres: of a window of corners, or of those tracked in a map of another unit.

Shared values keep their unit, so a scale found late begins a new submap instead of rescaling the old one.
"""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.imaging import features
from kiteline_agent.imaging.feature_kernels import BORDER
from kiteline_agent.initialisation.corner_tracks import CornerObservations
from kiteline_agent.initialisation.window import lens_correction
from kiteline_agent.initialisation.window.window_state import WindowSolution
from kiteline_agent.keyframes.new_landmarks import NewPoints, moved_to_frame, shown_by_rows
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import KeyframeId
from kiteline_core.order_statistics import median

_MIN_DEPTH_M = 0.1  # m of a landmark in the newest camera of a window
_DEPTH_SIGMA = 0.25  # relative deviation above which a landmark of a window has no depth yet
_MIN_SIGMA_PX = 0.06  # px of virtual disparity, of depths that many frames have sharpened


@dataclass(frozen=True, slots=True)
class MetricPoints:
    """New landmarks of the first keyframe in metres, in the order in which they are shared. sigma_rho: (n,) 1/m."""

    points: NewPoints
    sigma_rho: F64

    def median_depth_m(self, camera: RectifiedCamera) -> float:
        """Their median depth."""
        return camera.bf / median(self.points.disparity)

    def at_frame(self, shutter: RollingShutter, camera: RectifiedCamera) -> "MetricPoints":
        """These, which a rolling shutter showed, where they are at the frame's stamp, of which their depths are."""
        disparity = self.points.disparity
        return replace(self, points=replace(moved_to_frame(self.points, camera, shutter), disparity=disparity))

    def set_sigma(self, local_map: LocalMap, keyframe: KeyframeId) -> None:
        """Write the deviations of their depths into the local map."""
        slot = local_map.slot_of(keyframe)
        n = int(local_map.counts[slot])
        local_map.sigma_rho[slot, :n] = self.sigma_rho[:n]


def metric_points(
    ctx: FrameContext, track: Track, local_map: LocalMap, unit_m: float, lens: F64 | None = None
) -> MetricPoints:
    """The inliers of a track as new landmarks of its frame. unit_m: metres in one unit of the old map.

    lens: (8,) errors with which the frame's pixels are corrected from here on, and were not when it was tracked.
    """
    keep = np.flatnonzero(track.inlier)
    depth = track.depth_m[keep]
    relative = np.linalg.norm(track.ray[keep], axis=1) / depth
    octave = local_map.octave[track.rows[keep]]
    uv = track.observed[keep, :2]
    if lens is not None:
        uv = _true_pixels(uv, lens, local_map.camera)
    found = metric_points_at(ctx, uv, octave, unit_m * depth, relative, local_map.camera)
    if ctx.shutter is None:
        return found
    return replace(found, points=shown_by_rows(found.points, local_map.camera, ctx.shutter.scaled(unit_m)))


def window_points(
    ctx: FrameContext, corners: CornerObservations, solution: WindowSolution, camera: RectifiedCamera
) -> MetricPoints | None:
    """The corners of a window's newest keyframe, at ctx, whose depth is known, as the corrected lens shows them."""
    seen = corners.seen[-1] & (solution.depth_m > _MIN_DEPTH_M) & (solution.depth_sigma < _DEPTH_SIGMA)
    if not (bool(seen.any()) and np.isfinite(solution.depth_sigma[seen]).all()):
        return None
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    uv = corners.xy[-1, seen] * focal + centre
    octave = np.zeros(len(uv), np.uint8)
    found = metric_points_at(ctx, uv, octave, solution.depth_m[seen], solution.depth_sigma[seen], camera)
    true = _true_pixels(found.points.uv, solution.state.lens, camera)
    return replace(found, points=replace(found.points, uv=true))


def _true_pixels(uv: F64, lens: F64, camera: RectifiedCamera) -> F64:
    """Where a true camera would show what this one shows at pixels (n,2). lens: (8,) its errors."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    return np.asarray(lens_correction.true_place((uv - centre) / focal, lens) * focal + centre)


def metric_points_at(
    ctx: FrameContext, uv: F64, octave: U8, depth_m: F64, depth_sigma: F64, camera: RectifiedCamera
) -> MetricPoints:
    """Pixels (n,2) of a frame as new landmarks, at depths (n,). depth_sigma: (n,) their relative deviations."""
    margin = (BORDER + 1.0) * (1 << octave.astype(np.int64))[:, None]
    inside = (uv >= margin).all(axis=1) & (uv < np.array([camera.width, camera.height]) - margin).all(axis=1)
    keep = np.flatnonzero(inside)
    keep = keep[np.argsort(depth_sigma[keep], kind="stable")[: ctx.config.local_map.landmarks]]
    keep = keep[np.lexsort((uv[keep, 0], uv[keep, 1] // ctx.config.detector.cell_px))]
    rho = 1.0 / depth_m[keep]
    angle, descriptor = features.describe(ctx.images.left, uv[keep], octave[keep])
    points = NewPoints(uv[keep], camera.bf * rho, octave[keep], angle, descriptor)
    return MetricPoints(points, np.maximum(depth_sigma[keep] * rho, _MIN_SIGMA_PX / camera.bf))

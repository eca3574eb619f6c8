"""Corners that become the new landmarks of a keyframe."""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging import features, stereo_kernels
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_agent.tracking.frame_images import FrameImages, depth_at
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_core.geometry.cameras import RectifiedCamera

_SEARCH_PX = 2.5  # px of the level: range of sub-pixel stereo around the coarse search, whose step is 2 px
_UNIQUENESS = 1.15  # second-best cost over best; below it the row repeats itself


@dataclass(frozen=True, slots=True)
class RowShift:
    """Where a rolling shutter's rows show landmarks.

    shift_px: (n,2) from where they are at the frame's stamp. rho: (n,) 1/m, the inverse depths for which that holds.
    parallax_m: (n,2) by which x/z and y/z at the stamp change with the inverse depth.
    """

    shift_px: F64
    rho: F64
    parallax_m: F64

    def part(self, keep: Bool | I64) -> "RowShift":
        """Those where `keep` (n,) is True, or those at these places."""
        return RowShift(self.shift_px[keep], self.rho[keep], self.parallax_m[keep])


@dataclass(frozen=True, slots=True)
class NewPoints:
    """New landmarks of a keyframe, strongest first.

    uv: (n,2) px. disparity: (n,) px, -1 unknown. octave: (n,). angle: (n,) 1/256 turns. descriptor: (n,32). row_shift:
    by a rolling shutter; None: by a global one, or its motion is unknown.
    """

    uv: F64
    disparity: F64
    octave: U8
    angle: U8
    descriptor: U8
    row_shift: RowShift | None = None

    def part(self, keep: Bool) -> "NewPoints":
        """Those where `keep` (n,) is True."""
        shift = None if self.row_shift is None else self.row_shift.part(keep)
        return NewPoints(
            self.uv[keep], self.disparity[keep], self.octave[keep], self.angle[keep], self.descriptor[keep], shift
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class EarlierView:
    """A keyframe of a frame before a map's first one, for the base alone.

    T_n_k: (4,4) its camera in that of the map's first frame. points: its corners, without depths, as a true camera
    shows them. ids: (n,) of those that other such keyframes show too, increasing; -1 of the others, which come last.
    """

    t_ns: int
    T_n_k: F64
    points: NewPoints
    ids: I64


def new_points(images: FrameImages, taken: F64, camera: RectifiedCamera, config: AgentConfig) -> NewPoints:
    """Detect corners away from pixels `taken` (n,2); depth from the right image or the depth image where measurable."""
    detector = config.detector
    if images.first > detector.first:
        detector = replace(detector, first=images.first)
    corners = features.detect(images.left, taken, detector)
    disparity = np.full(len(corners.uv), -1.0)
    if images.right is not None:
        stereo = config.stereo
        widest = min(camera.bf / stereo.min_depth_m, 0.45 * camera.width)
        stereo_kernels.search_rows(
            images.aligned, images.right.coarse(), corners.uv, corners.octave, widest, _UNIQUENESS, disparity
        )
        found = np.zeros(len(disparity), np.bool_)
        images.right.refine(
            images.aligned, NO_GRID, corners.uv, corners.octave, found.copy(), np.zeros((len(found), 2)), _SEARCH_PX,
            disparity, found,
        )  # fmt: skip
        disparity[~found] = -1.0
        disparity[disparity < camera.fx / config.local_map.max_far_ratio] = -1.0
    elif images.depth_m is not None:
        depth = depth_at(images.depth_m, corners.uv)
        disparity = np.where(depth > 0.0, camera.bf / np.maximum(depth, 1e-3), -1.0)
    # Corners with depth first: only they are tracked at once.
    order = np.argsort(disparity < 0.0, kind="stable")[: config.local_map.landmarks]
    uv, octave = corners.uv[order], corners.octave[order]
    angle, descriptor = features.describe(images.left, uv, octave)
    return NewPoints(uv, disparity[order], octave, angle, descriptor)


def moved_to_frame(
    points: NewPoints, camera: RectifiedCamera, shutter: RollingShutter, rho: F64 | None = None
) -> NewPoints:
    """Landmarks that rows show, where they are at the frame's stamp.

    rho: (n,) 1/m of those without a depth; None: they are far away.
    """
    has_depth = points.disparity > 0.0
    disparity = shutter.at_once(points.uv, points.disparity)
    rho = np.where(has_depth, disparity / camera.bf, 0.0 if rho is None else rho)
    moved, parallax_m = shutter.to_frame_with_parallax(points.uv, rho)
    uv = np.clip(moved[:, :2], 0.0, [camera.width - 1.0, camera.height - 1.0])
    disparity = np.where(has_depth, disparity * moved[:, 2], disparity)
    return replace(points, uv=uv, disparity=disparity, row_shift=RowShift(points.uv - uv, rho, parallax_m))


def shown_by_rows(points: NewPoints, camera: RectifiedCamera, shutter: RollingShutter) -> NewPoints:
    """Landmarks at the frame's stamp whose depths are known, with where rows show them."""
    rho = points.disparity / camera.bf
    shown = shutter.to_rows(points.uv, rho)[:, :2]
    _, parallax_m = shutter.to_frame_with_parallax(shown, rho)
    return replace(points, row_shift=RowShift(shown - points.uv, rho, parallax_m))


def nearby(uv: F64, places: F64, values: F64) -> F64:
    """Values (n,) at pixels (n,2) from those (m,) at pixels places (m,2), weighted by the inverse square distance.

    Zero if there are none.
    """
    if not len(places):
        return np.zeros(len(uv))
    weight = 1.0 / (np.square(uv[:, None] - places[None]).sum(axis=2) + 1.0)
    return np.asarray(weight @ values / weight.sum(axis=1))

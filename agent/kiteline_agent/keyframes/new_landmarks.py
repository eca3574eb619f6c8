"""Corners that become the new landmarks of a keyframe."""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging import features, stereo_kernels
from kiteline_agent.tracking.frame_images import NO_GRID, FrameImages, depth_at
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_core.geometry.cameras import RectifiedCamera

_SEARCH_PX = 2.5  # px of the level: range of sub-pixel stereo around the coarse search, whose step is 2 px
_UNIQUENESS = 1.15  # second-best cost over best; below it the row repeats itself


@dataclass(frozen=True, slots=True)
class NewPoints:
    """New landmarks of a keyframe, strongest first.

    uv: (n,2) px. disparity: (n,) px, -1 unknown. octave: (n,). angle: (n,) 1/256 turns. descriptor: (n,32). roll_px:
    (n,2) by which they are away from uv in the image of a rolling shutter; None: of a global one.
    """

    uv: F64
    disparity: F64
    octave: U8
    angle: U8
    descriptor: U8
    roll_px: F64 | None = None

    def part(self, keep: Bool) -> "NewPoints":
        """Those where `keep` (n,) is True."""
        roll_px = None if self.roll_px is None else self.roll_px[keep]
        return NewPoints(
            self.uv[keep], self.disparity[keep], self.octave[keep], self.angle[keep], self.descriptor[keep], roll_px
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


def moved_to_frame(points: NewPoints, camera: RectifiedCamera, shutter: RollingShutter) -> NewPoints:
    """Landmarks where they are at the frame's stamp; one without a depth is taken as far away."""
    moved = shutter.to_frame(points.uv, np.maximum(points.disparity, 0.0) / camera.bf)
    uv = np.clip(moved[:, :2], 0.0, [camera.width - 1.0, camera.height - 1.0])
    disparity = np.where(points.disparity > 0.0, points.disparity * moved[:, 2], points.disparity)
    return replace(points, uv=uv, disparity=disparity, roll_px=points.uv - uv)

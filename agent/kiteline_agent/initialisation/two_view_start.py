"""Starts a monocular map: follows corners of a first frame until two views give motion and depth.

The scale is free: the median depth of the first landmarks is set to a convention, and the map keeps that scale.
"""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging import alignment_kernels, features
from kiteline_agent.imaging.alignment_kernels import ALIGN_ITERATIONS, FINE_STEP_PX, MIN_NCC
from kiteline_agent.imaging.optical_flow import Flow
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_agent.initialisation.frame_flow import FrameFlow
from kiteline_agent.initialisation.two_view import MIN_POINTS, two_view
from kiteline_agent.keyframes.depth_from_motion import triangulated_sigma
from kiteline_agent.keyframes.new_landmarks import NewPoints
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.frame_images import FrameImages
from kiteline_agent.tracking.pose_state import scaled
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import KeyframeId
from kiteline_core.order_statistics import median

_CORNERS = 400  # corners followed from the first frame; half of them are lost or have no parallax
_FLOW = Flow(window_px=15, border_px=4.0, return_px=1.0)  # the smallest window that keeps hold of corners
_MIN_SHARE = 0.4  # of the first corners; with fewer left a new first frame is taken
_MAX_S = 1.98  # s after which a new first frame is taken: the view has changed too much


@dataclass(frozen=True, slots=True)
class TwoViewMap:
    """The first keyframe of a map, triangulated from a second view.

    images, t_ns: of the first frame. T_m_a: (4,4) where it was predicted. frames: from there to the second one. T_a_b:
    (4,4) second camera in the first. points: new landmarks in the first frame. median_depth_m: theirs.
    """

    images: FrameImages
    t_ns: int
    T_m_a: F64
    frames: int
    T_a_b: F64
    points: NewPoints
    median_depth_m: float

    def scaled(self, factor: float) -> "TwoViewMap":
        """The same with all lengths `factor` times as long."""
        return replace(
            self, T_a_b=scaled(self.T_a_b, factor), median_depth_m=factor * self.median_depth_m,
            points=replace(self.points, disparity=self.points.disparity / factor),
        )  # fmt: skip

    def set_sigma(self, local_map: LocalMap, keyframe: KeyframeId, sigma_px: float) -> None:
        """Write the deviations of the triangulated depths into the local map. sigma_px: of a pixel at octave 0."""
        slot = local_map.slot_of(keyframe)
        n = int(local_map.counts[slot])
        octave = local_map.octave[slot * local_map.slot_size : slot * local_map.slot_size + n]
        local_map.sigma_rho[slot, :n] = triangulated_sigma(
            local_map.bearing[slot, :n], local_map.rho[slot, :n], se3.inverse(self.T_a_b),
            local_map.camera.fx, sigma_px * np.exp2(octave.astype(np.float64)),
        )  # fmt: skip


class TwoViewStart:
    """Follows the corners of a first frame through the frames after it."""

    def __init__(self, camera: RectifiedCamera, config: AgentConfig, work: Work) -> None:
        self._camera = camera
        self._config = config
        self._work = work
        self._detector = replace(config.detector, cell_px=config.two_view_start.cell_px, max_corners=_CORNERS)
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        self._median_depth_m = config.two_view_start.median_depth_m
        self._first: FrameImages | None = None
        self._first_t_ns, self._T_m_first = 0, np.eye(4)
        self._frames = 0
        self._corners = FrameFlow(_FLOW)  # that are still followed
        self._uv0 = np.zeros((0, 2))
        self._octave = np.zeros(0, np.uint8)
        self._templates = np.zeros((0, 3, alignment_kernels.TEMPLATE, alignment_kernels.TEMPLATE), np.uint8)
        self._index = np.zeros(0, np.int64)  # template of each of them

    @property
    def at_first_view(self) -> bool:
        """True if the next frame will be the first view of a map."""
        return self._first is None

    def note_depths(self, depth_m: F64) -> None:
        """A map is tracked, at these depths (n,): a later start takes on their scale, from a new first frame."""
        self._first = None
        if len(depth_m):
            self._median_depth_m = median(depth_m)

    def rescale(self, factor: float) -> None:
        """Change the unit of length: all lengths grow by `factor`."""
        self._median_depth_m *= factor

    def add(self, ctx: FrameContext) -> TwoViewMap | None:
        """Take in a frame. Returns a map once this frame and the first one give enough landmarks."""
        self._work.searches += 1
        config = self._config.two_view_start
        if self._first is None:
            self._begin(ctx)
            return None
        self._frames += 1
        if not self._follow(ctx.images):
            return None
        flow = np.linalg.norm(self._corners.uv - self._uv0, axis=1)
        start = None
        if self._corners.smooth and len(flow) >= MIN_POINTS and np.median(flow) > config.min_flow * self._camera.fx:
            start = self._reconstruct(self._first, ctx.images)
        few = len(self._corners.uv) < max(MIN_POINTS, _MIN_SHARE * len(self._templates))
        if start is not None:
            self._first = None
        elif few or (ctx.t_ns - self._first_t_ns) * 1e-9 >= _MAX_S:
            self._begin(ctx)
        return start

    def _begin(self, ctx: FrameContext) -> None:
        """Make this frame the first one."""
        images = ctx.images
        corners = features.detect(images.left, np.zeros((0, 2)), self._detector)
        self._first, self._first_t_ns, self._frames = replace(images, right=None), ctx.t_ns, 0
        self._T_m_first = ctx.T_m_c
        self._corners.begin(images.left[0], corners.uv)
        self._uv0, self._octave = corners.uv, corners.octave
        self._templates = np.empty((len(corners.uv), *self._templates.shape[1:]), np.uint8)
        self._index = np.arange(len(corners.uv))
        alignment_kernels.cut_templates(images.aligned, corners.uv, corners.octave, self._templates)

    def _follow(self, images: FrameImages) -> bool:
        """Follow the corners from the last frame that showed them. False if this one does not."""
        good = self._corners.follow(images.left[0])
        if good is None:
            return False
        self._uv0, self._octave, self._index = self._uv0[good], self._octave[good], self._index[good]
        return True

    def _reconstruct(self, first: FrameImages, images: FrameImages) -> TwoViewMap | None:
        """Align the corners with their templates, and solve for motion and depth."""
        n, uv = len(self._corners.uv), self._corners.uv.copy()
        found, ncc = np.zeros(n, np.bool_), np.zeros(n)
        warp = np.tile(self._mean_warp(), (n, 1, 1))
        alignment_kernels.align(
            images.aligned, NO_GRID, self._templates, self._index, self._octave, warp, uv, 0, 0,
            ALIGN_ITERATIONS, FINE_STEP_PX, MIN_NCC, found, ncc,
        )  # fmt: skip
        uv[~found] = self._corners.uv[~found]
        seen = two_view(self._uv0, uv, self._intrinsics, self._frames)
        if seen is None:
            return None
        factor = self._median_depth_m / float(np.median(seen.points[seen.good, 2]))
        T_a_b = se3.inverse(seen.T_b_a)
        T_a_b[:3, 3] *= factor
        rows = np.flatnonzero(seen.good)[: self._config.local_map.landmarks]
        place, octave = self._uv0[rows], self._octave[rows]
        angle, descriptor = features.describe(first.left, place, octave)
        disparity = self._camera.bf / (seen.points[rows, 2] * factor)
        points = NewPoints(place, disparity, octave, angle, descriptor)
        return TwoViewMap(first, self._first_t_ns, self._T_m_first, self._frames, T_a_b, points, self._median_depth_m)

    def _mean_warp(self) -> F64:
        """Linear part (2,2) of the affine map that fits the corners of the first frame to those of the last."""
        a = np.column_stack([self._uv0, np.ones(len(self._uv0))])
        return np.ascontiguousarray(np.linalg.lstsq(a, self._corners.uv, rcond=None)[0][:2].T)

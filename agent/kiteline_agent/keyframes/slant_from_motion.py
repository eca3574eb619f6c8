"""Slant of the surfaces around landmarks: each tracked frame tells how their templates are sheared.

A template that is warped as if its surface faced the camera is sheared against the image once the camera has moved: the
alignment ends off the landmark, by half a pixel where a road or a wall comes twice as near.
"""

import numpy as np

from kiteline_agent.config import SlantConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging.slant_kernels import fuse_slants, measure_slants
from kiteline_agent.local_map import projection_kernels
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64, I64

_LEAST_GREY = 2.0  # grey levels; deviation of a pixel: noise, and what interpolation costs
_LONGEST_S = 0.15  # s between frames; of slower cameras a landmark is seen too few times, too differently
_INFLATION = 16.0  # factor on variances: pixels of a patch share errors of the lens and of blur, all those of the pose
_MOST_CHANGE = 0.5  # of the inverse depth, from the middle of a patch to its edge: steeper surfaces are edges


class SlantFromMotion:
    """Updates slants of a local map from each tracked frame."""

    def __init__(self, local_map: LocalMap, work: Work) -> None:
        self._map = local_map
        self._work = work

    def update(self, ctx: FrameContext, track: Track) -> None:
        """Update the slants of the landmarks that a frame tracked on levels that it has.

        Not if the frame before is long past: what few and distant views tell makes templates worse.
        """
        if ctx.dt_s > _LONGEST_S:
            return
        m, images, config = self._map, ctx.images, ctx.config.slant
        chosen = np.flatnonzero(track.inlier & (m.octave.take(track.rows) >= images.first))[: config.points]
        if not len(chosen):
            return
        rows, uv = track.rows.take(chosen), track.observed.take(chosen, 0)[:, :2]
        if ctx.shutter is not None:
            at_row = ctx.shutter.to_rows(uv, 1.0 / track.depth_m.take(chosen))[:, :2]
            uv = np.where(m.rolled[rows // m.slot_size, None], uv, at_row)
        warp, parallax, equations = np.empty((len(rows), 2, 2)), np.empty((len(rows), 2)), np.empty((len(rows), 5))
        projection_kernels.views(
            track.T_c_m, m.intrinsics, rows, m.T_m_k, m.bearing, m.rho, m.slant, warp, parallax
        )  # fmt: skip
        measure_slants(
            images.sampled, images.grid, m.templates, rows, m.octave.take(rows), warp, parallax,
            np.ascontiguousarray(uv), m.camera.fx, m.camera.fy, _LEAST_GREY, equations,
        )  # fmt: skip
        self._work.slants += len(rows)
        self._fuse(rows, equations / _INFLATION, config)

    def _fuse(self, rows: I64, equations: F64, config: SlantConfig) -> None:
        """Take over measurements (n,5) of rows (n,), see `measure_slants`: the most probable slants after them."""
        m, most_forgotten, prior = self._map, max(1.0 - config.memory, 0.0), config.sigma**-2
        known, slant = m.slant_equations.reshape(-1, 5), m.slant.reshape(-1, 2)
        fuse_slants(
            rows, m.octave.take(rows), equations, most_forgotten, prior, m.camera.fx, _MOST_CHANGE, known, slant
        )

"""Slant of the surfaces around landmarks: each tracked frame tells how their templates are sheared.

A template that is warped as if its surface faced the camera is sheared against the image once the camera has moved: the
alignment ends off the landmark, by half a pixel where a road or a wall comes twice as near.
"""

import numpy as np

from kiteline_agent.config import SlantConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging import slants
from kiteline_agent.imaging.slant_kernels import measure_slants
from kiteline_agent.local_map import projection_kernels
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track


class SlantFromMotion:
    """Updates slants of a local map from each tracked frame."""

    def __init__(self, local_map: LocalMap, config: SlantConfig, work: Work) -> None:
        self._map = local_map
        self._config = config
        self._work = work

    def update(self, ctx: FrameContext, track: Track) -> None:
        """Update the slants of the landmarks that a frame tracked on levels that it has."""
        m, images = self._map, ctx.images
        chosen = np.flatnonzero(track.inlier & (m.octave.take(track.rows) >= images.first))[: self._config.points]
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
            np.ascontiguousarray(uv), 1.0 / m.camera.fx, slants.LEAST_GREY, equations,
        )  # fmt: skip
        self._work.slants += len(rows)
        # Frames share the errors of the template: what earlier ones told counts less.
        slant, known = m.slant.reshape(-1, 2), m.slant_equations.reshape(-1, 5)
        told = slants.about_zero(equations, slant.take(rows, 0))
        known[rows] = total = self._config.memory * known.take(rows, 0) + told
        slant[rows] = slants.most_probable(total, self._config.sigma, m.octave.take(rows), m.camera.fx)

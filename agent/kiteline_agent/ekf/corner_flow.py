"""Corners followed from frame to frame, with an id each.

Optical flow finds where a corner went, but drifts: by half a pixel in a second, alike over frames, which a filter takes
for motion. So each corner is aligned with the image in which it was found, warped by the rotation since and, once the
filter knows it, by its distance.
"""

import numpy as np

from kiteline_agent.ekf_config import EkfConfig
from kiteline_agent.imaging import alignment_kernels, features, optical_flow
from kiteline_agent.imaging.alignment_kernels import ALIGN_ITERATIONS, MIN_NCC, TEMPLATE, TEMPLATE_LEVELS
from kiteline_agent.imaging.features import DetectorConfig, Pyramid
from kiteline_agent.imaging.optical_flow import Flow
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_core.geometry.cameras import RectifiedCamera

_FLOW = Flow(window_px=21)
_SLIDE_PX = 3.0  # px of its octave between the flow and a corner's template at most
_REPLENISH = 0.75  # share of the option `corners` below which new ones are searched


class CornerFlow:
    """Follows corners; ids increase and are never used again."""

    def __init__(self, camera: RectifiedCamera, detector: DetectorConfig, config: EkfConfig) -> None:
        self._focal, self._centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        self._detector, self._config = detector, config
        self._last: Pyramid | None = None
        self._next_id = 0
        self.ids: I64 = np.zeros(0, np.int64)  # (n,) increasing
        self.uv = np.zeros((0, 2))  # (n,2) px of the newest frame
        self.octave: U8 = np.zeros(0, np.uint8)  # (n,) of the frame in which the corner was found
        # Of that frame: pixels (n,2), camera (n,4,4) in o, and templates (n,3,21,21).
        self._first_uv, self._first_T_o_c = np.zeros((0, 2)), np.zeros((0, 4, 4))
        self._templates: U8 = np.zeros((0, TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)

    def follow(self, left: Pyramid) -> None:
        """Follow the corners into a frame by optical flow."""
        if self._last is not None and len(self.ids):
            self.uv, found = optical_flow.follow(self._last[0], left[0], self.uv, _FLOW)
            self._keep(found)
        self._last = left

    def align(self, left: Pyramid, T_o_c: F64, depth_m: F64) -> None:
        """Align the corners with their templates, and drop those that look otherwise now.

        T_o_c: (4,4) the camera now, as predicted. depth_m: (n,) distances along its axis; 0 where not known.
        """
        n = len(self.ids)
        found, ncc, uv = np.zeros(n, np.bool_), np.zeros(n), self.uv.copy()
        alignment_kernels.align(
            left, NO_GRID, self._templates, np.arange(n), self.octave, self._warps(T_o_c, depth_m), uv, 0, 0,
            ALIGN_ITERATIONS, _SLIDE_PX, MIN_NCC, found, ncc,
        )  # fmt: skip
        self.uv = uv
        self._keep(found)

    def replenish(self, left: Pyramid, T_o_c: F64) -> None:
        """Find new corners where few are left."""
        if len(self.ids) >= _REPLENISH * self._config.corners:
            return
        found = features.detect(left, self.uv, self._detector)
        n = min(len(found.uv), self._config.corners - len(self.ids))
        templates = np.zeros((n, TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
        alignment_kernels.cut_templates(left, found.uv[:n], found.octave[:n], templates)
        self.ids = np.concatenate([self.ids, self._next_id + np.arange(n)])
        self.uv = np.concatenate([self.uv, found.uv[:n]])
        self.octave = np.concatenate([self.octave, found.octave[:n]])
        self._first_uv = np.concatenate([self._first_uv, found.uv[:n]])
        self._first_T_o_c = np.concatenate([self._first_T_o_c, np.tile(T_o_c, (n, 1, 1))])
        self._templates = np.concatenate([self._templates, templates])
        self._next_id += n

    def drop(self, ids: I64) -> None:
        """Forget corners."""
        self._keep(~np.isin(self.ids, ids))

    def _keep(self, keep: Bool) -> None:
        if keep.all():
            return
        self.ids, self.uv, self.octave = self.ids[keep], self.uv[keep], self.octave[keep]
        self._first_uv, self._first_T_o_c = self._first_uv[keep], self._first_T_o_c[keep]
        self._templates = self._templates[keep]

    def _warps(self, T_o_c: F64, depth_m: F64) -> F64:
        """Derivatives (n,2,2) of the pixels now by those in the first frames, on surfaces that faced the camera there.

        Where the distance is not known, by rotation alone.
        """
        R = np.einsum("ji,njk->nik", T_o_c[:3, :3], self._first_T_o_c[:, :3, :3])  # first camera to that of now
        ray = np.column_stack([(self._first_uv - self._centre) / self._focal, np.ones(len(R))])
        turned = np.einsum("nij,nj->ni", R, ray)  # the landmark now, if the camera only turned
        known = depth_m > 0.0
        now = np.column_stack([(self.uv - self._centre) / self._focal, np.ones(len(R))])
        there = now * depth_m[:, None] + (T_o_c[:3, 3] - self._first_T_o_c[:, :3, 3]) @ T_o_c[:3, :3]
        first_m = np.einsum("ni,ni->n", there, R[:, :, 2])  # distance in the first camera
        known &= first_m > 0.0
        ratio = np.where(known, first_m / np.where(known, depth_m, 1.0), 1.0 / np.maximum(turned[:, 2], 1e-3))
        at = np.where(known[:, None], now[:, :2], turned[:, :2] / np.maximum(turned[:, 2:], 1e-3))
        slopes = ratio[:, None, None] * (R[:, :2, :2] - at[:, :, None] * R[:, 2, None, :2])
        return np.ascontiguousarray(slopes * self._focal[:, None] / self._focal[None, :])

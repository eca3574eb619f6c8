"""Aligns the landmarks of a window with their first image again, where the window's geometry predicts them.

Optical flow drifts from keyframe to keyframe; an alignment with one template, warped by the geometry, does not. Nor
does it end off a landmark whose surface is slanted.
"""

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging import alignment_kernels, slants
from kiteline_agent.imaging.alignment_kernels import ALIGN_ITERATIONS, MIN_NCC, TEMPLATE, TEMPLATE_LEVELS
from kiteline_agent.imaging.slant_kernels import measure_slants
from kiteline_agent.initialisation.corner_tracks import CornerObservations, TrackedKeyframe
from kiteline_agent.initialisation.window import lens_correction
from kiteline_agent.initialisation.window.window_state import WindowState
from kiteline_agent.tracking.frame_images import NO_GRID
from kiteline_core.arrays import F64, I64, U8
from kiteline_core.geometry.cameras import RectifiedCamera

_OFFSET_PX = 4.0  # px: half of a patch, over which the warp is linear
_MARGIN_PX = 12.0  # px to the image's border
_MAX_STEP_PX = 3.0  # px that the alignment may move on a level
_MAX_OFF_PX = 6.0  # px between prediction and result
_MAX_SCALE = 3.0  # of areas
_SMALL = 0.01  # of an inverse depth: a change over which a pixel moves linearly


def realigned(
    keyframes: list[TrackedKeyframe], observations: CornerObservations, state: WindowState, xyz: F64, first: I64,
    camera: RectifiedCamera, config: AgentConfig,
) -> CornerObservations:  # fmt: skip
    """Observations by alignment. xyz: (P,3) m landmarks in w. first: (P,) keyframe that saw each first.

    Each keyframe tells how surfaces are slanted, which warps the templates in the next ones.
    """
    f, c = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    R, centre = state.R @ camera.T_b_c[:3, :3], state.p + state.R @ camera.T_b_c[:3, 3]
    columns = np.arange(len(xyz))
    xy0 = observations.xy[first, columns]
    templates = _templates(keyframes, xy0 * f + c, first)
    patches = _Patches(xyz, xy0, R[first], centre[first], state, f)
    xy, seen = observations.xy.copy(), np.zeros_like(observations.seen)
    octave, slant, equations = np.zeros(len(xyz), np.uint8), np.zeros((len(xyz), 2)), np.zeros((len(xyz), 5))
    size = np.array([camera.width, camera.height]) - _MARGIN_PX
    for k, keyframe in enumerate(keyframes):
        uv, depth, warp, parallax = patches.seen(R[k], centre[k], c, slant)
        area = np.abs(np.linalg.det(warp))
        inside = (uv > _MARGIN_PX).all(axis=1) & (uv < size).all(axis=1) & (depth > 0.1)
        rows = np.flatnonzero((first < k) & inside & (area > 1.0 / _MAX_SCALE) & (area < _MAX_SCALE))
        place = np.where(observations.seen[k][:, None], observations.xy[k] * f + c, uv)[rows].copy()
        found, ncc = np.zeros(len(rows), np.bool_), np.zeros(len(rows))
        alignment_kernels.align(
            keyframe.left, NO_GRID, templates, rows, octave[rows], np.ascontiguousarray(warp[rows]), place, 1, 0,
            ALIGN_ITERATIONS, _MAX_STEP_PX, MIN_NCC, found, ncc,
        )  # fmt: skip
        good = found & (np.linalg.norm(place - uv[rows], axis=1) < _MAX_OFF_PX)
        rows, place = rows[good], place[good]
        xy[k, rows], seen[k, rows] = (place - c) / f, True
        if config.slant.points:
            told = np.empty((len(rows), 5))
            measure_slants(
                keyframe.left, NO_GRID, templates, rows, octave[rows], np.ascontiguousarray(warp[rows]),
                np.ascontiguousarray(parallax[rows]), place, 1.0 / camera.fx, slants.LEAST_GREY, told,
            )  # fmt: skip
            equations[rows] += slants.about_zero(told, slant[rows])
            slant[rows] = slants.most_probable(equations[rows], config.slant.sigma, octave[rows], camera.fx)
    seen[first, columns] = True
    return CornerObservations(xy, seen, observations.ids)


class _Patches:
    """The surfaces around landmarks, as the keyframes that saw them first have them."""

    def __init__(self, xyz: F64, xy0: F64, R: F64, centre: F64, state: WindowState, f: F64) -> None:
        """xyz: (P,3) m. xy0: (P,2) where the first keyframe saw each. R (P,3,3), centre (P,3): of these. f: (2,) px."""
        self._xyz, self._centre, self._lens, self._f = xyz, centre, state.lens, f
        self._depth = np.einsum("pi,pi->p", xyz - centre, R[:, :, 2])
        self._offsets = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]) * _OFFSET_PX / f
        beside = [lens_correction.true_place(xy0 + offset, state.lens) for offset in self._offsets]
        self._rays = [np.einsum("pij,pj->pi", R, np.column_stack([at, np.ones(len(xyz))])) for at in beside]

    def seen(self, R: F64, centre: F64, c: F64, slant: F64) -> tuple[F64, F64, F64, F64]:
        """Pixels (P,2), depths (P,) m, warps (P,2,2) and parallaxes (P,2) px in a camera at R (3,3), centre (3,).

        slant: (P,2), see `measure_slants`.
        """
        nearer = self._centre + (self._xyz - self._centre) / (1.0 + _SMALL)
        beside = [
            self._centre + ray * (self._depth / np.maximum(1.0 + slant @ offset, _SMALL))[:, None]
            for ray, offset in zip(self._rays, self._offsets, strict=True)
        ]
        local = [(x - centre) @ R for x in (self._xyz, nearer, *beside)]
        uv = [lens_correction.moved(p[:, :2] / np.maximum(p[:, 2:], 1e-3), self._lens) * self._f + c for p in local]
        warp = np.stack([uv[2] - uv[3], uv[4] - uv[5]], axis=2) / (2.0 * _OFFSET_PX)
        return uv[0], local[0][:, 2], warp, (uv[1] - uv[0]) / _SMALL


def _templates(keyframes: list[TrackedKeyframe], uv: F64, first: I64) -> U8:
    """Templates (P,3,21,21) of the landmarks, each from the keyframe that saw it first, there at uv (P,2)."""
    templates = np.zeros((len(uv), TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
    for k, keyframe in enumerate(keyframes):
        rows = np.flatnonzero(first == k)
        if len(rows):
            part = np.zeros((len(rows), TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
            alignment_kernels.cut_templates(keyframe.left, uv[rows], np.zeros(len(rows), np.uint8), part)
            templates[rows] = part
    return templates

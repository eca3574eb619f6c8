"""Aligns the landmarks of a window with their first image again, where the window's geometry predicts them.

Optical flow drifts from keyframe to keyframe; an alignment with one template, warped by the geometry, does not.
"""

from collections.abc import Sequence

import numpy as np

from kiteline_agent.imaging import alignment_kernels
from kiteline_agent.imaging.alignment_kernels import ALIGN_ITERATIONS, MIN_NCC, TEMPLATE, TEMPLATE_LEVELS
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_agent.initialisation.corner_tracks import CornerObservations, TrackedKeyframe
from kiteline_agent.initialisation.window import lens_correction
from kiteline_agent.initialisation.window.rolling_rows import RollingRows, shifts
from kiteline_agent.initialisation.window.window_state import WindowState
from kiteline_core.arrays import F64, I64, U8
from kiteline_core.geometry.cameras import RectifiedCamera

_OFFSET_PX = 4.0  # px: half of a patch, over which the warp is linear
_MARGIN_PX = 12.0  # px to the image's border
_MAX_STEP_PX = 3.0  # px that the alignment may move on a level
_MAX_OFF_PX = 6.0  # px between prediction and result
_MAX_SCALE = 3.0  # of areas


def realigned(
    keyframes: Sequence[TrackedKeyframe], observations: CornerObservations, state: WindowState, xyz: F64, first: I64,
    camera: RectifiedCamera, rolling: RollingRows | None = None,
) -> CornerObservations:  # fmt: skip
    """Observations by alignment. xyz: (P,3) m landmarks in w. first: (P,) keyframe that saw each first.

    rolling: rows of a rolling shutter; None: a global one.
    """
    f, c = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    R, centre = state.R @ camera.T_b_c[:3, :3], state.p + state.R @ camera.T_b_c[:3, 3]
    columns = np.arange(len(xyz))
    xy0 = observations.xy[first, columns]
    templates = _templates(keyframes, xy0 * f + c, first)
    depth = np.einsum("pi,pi->p", xyz - centre[first], R[first, :, 2])
    corners = [xyz]
    for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        beside = lens_correction.true_place(xy0 + np.array([du, dv]) * _OFFSET_PX / f, state.lens)
        ray = np.column_stack([beside, np.ones(len(xyz))])
        corners.append(centre[first] + np.einsum("pij,pj->pi", R[first], ray * depth[:, None]))
    xy, seen = observations.xy.copy(), np.zeros_like(observations.seen)
    octave = np.zeros(len(xyz), np.uint8)
    twists = None if rolling is None else rolling.twists(state, camera.T_b_c)
    size = np.array([camera.width, camera.height]) - _MARGIN_PX
    for k, keyframe in enumerate(keyframes):
        local = [(x - centre[k]) @ R[k] for x in corners]
        uv = [lens_correction.moved(p[:, :2] / np.maximum(p[:, 2:], 1e-3), state.lens) * f + c for p in local]
        if rolling is not None and twists is not None:
            rho = 1.0 / np.maximum(local[0][:, 2], 1e-3)
            place = (uv[0] - c) / f
            uv[0] = uv[0] + f * shifts(place[None], rho[None], twists[k : k + 1], rolling.row_times_s(place[None]))[0]
        warp = np.stack([uv[1] - uv[2], uv[3] - uv[4]], axis=2) / (2.0 * _OFFSET_PX)
        area = np.abs(np.linalg.det(warp))
        inside = (uv[0] > _MARGIN_PX).all(axis=1) & (uv[0] < size).all(axis=1) & (local[0][:, 2] > 0.1)
        rows = np.flatnonzero((first < k) & inside & (area > 1.0 / _MAX_SCALE) & (area < _MAX_SCALE))
        place = np.where(observations.seen[k][:, None], observations.xy[k] * f + c, uv[0])[rows].copy()
        found, ncc = np.zeros(len(rows), np.bool_), np.zeros(len(rows))
        alignment_kernels.align(
            keyframe.left, NO_GRID, templates, rows, octave[rows], np.ascontiguousarray(warp[rows]), place, 1, 0,
            ALIGN_ITERATIONS, _MAX_STEP_PX, MIN_NCC, found, ncc,
        )  # fmt: skip
        good = found & (np.linalg.norm(place - uv[0][rows], axis=1) < _MAX_OFF_PX)
        xy[k, rows[good]], seen[k, rows[good]] = (place[good] - c) / f, True
    seen[first, columns] = True
    return CornerObservations(xy, seen, observations.ids)


def _templates(keyframes: Sequence[TrackedKeyframe], uv: F64, first: I64) -> U8:
    """Templates (P,3,21,21) of the landmarks, each from the keyframe that saw it first, there at uv (P,2)."""
    templates = np.zeros((len(uv), TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
    for k, keyframe in enumerate(keyframes):
        rows = np.flatnonzero(first == k)
        if len(rows):
            part = np.zeros((len(rows), TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
            alignment_kernels.cut_templates(keyframe.left, uv[rows], np.zeros(len(rows), np.uint8), part)
            templates[rows] = part
    return templates

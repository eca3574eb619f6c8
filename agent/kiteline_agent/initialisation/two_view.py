"""Relative pose of two views and the points in both, from matched pixels; the distance between the views is 1.

A homography and a fundamental matrix are fitted; the ratio of their scores tells a flat scene or a pure rotation
(R. Mur-Artal, J. Montiel, J. Tardos, "ORB-SLAM", 2015, section IV). The motion that puts most points in front of both
views is refined by bundle adjustment.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from kiteline_agent.initialisation import two_view_models
from kiteline_core.arrays import F64, Bool
from kiteline_core.geometry import se3
from kiteline_core.geometry.triangulation import nearest_point, parallax, project, rays
from kiteline_core.optimisation.bundle import BundleConfig, BundleProblem, bundle

_DRAWS = 200  # of RANSAC for each model: 8 good points of 60 % come up with 97 %
_FLAT_RATIO = 0.45  # R_H above which the homography is the model
MIN_POINTS = 100  # with depth that a map needs
_RIVAL_SHARE = 0.75  # share of the best motion's points with which a second motion makes both ambiguous
_MIN_PARALLAX_RAD = 0.0175  # rad: 1 degree, median over the points; below it depth is noise
_MIN_POINT_PARALLAX_RAD = 0.005  # rad: with less a point has no depth
_REPROJECTION_PX = 2.0  # px: largest reprojection error of a point
_SIGMA_PX = 1.0  # px; one standard deviation of a matched pixel


@dataclass(frozen=True, slots=True)
class TwoView:
    """Result. T_b_a: (4,4), its translation has length 1. points: (n,3) in a. good: (n,) True if a point
    has a depth. flat: the homography was chosen. ratio: R_H.
    """

    T_b_a: F64
    points: F64
    good: Bool
    flat: bool
    ratio: float


def two_view(uv_a: F64, uv_b: F64, camera: F64, seed: int) -> TwoView | None:
    """Motion and points from pixels (n,2) that two views share; None if they are ambiguous. camera: fx fy cx cy."""
    if len(uv_a) < max(MIN_POINTS, 8):
        return None
    flat, ratio, model, fitted = _choose_model(uv_a, uv_b, seed)
    matrix = np.array([[camera[0], 0.0, camera[2]], [0.0, camera[1], camera[3]], [0.0, 0.0, 1.0]])
    motions = _homography_motions(model, matrix) if flat else _fundamental_motions(model, matrix)
    views = [_depths(T, uv_a, uv_b, fitted, camera) for T in motions]
    counts = np.array([np.count_nonzero(front) for _, front in views])
    best = int(np.argmax(counts))
    rivals = np.delete(counts, best)
    if counts[best] < MIN_POINTS:
        return None
    if len(rivals) and rivals.max() > _RIVAL_SHARE * counts[best]:
        return None
    return _refined(motions[best], *views[best], uv_a, uv_b, camera, flat, ratio)


def _choose_model(uv_a: F64, uv_b: F64, seed: int) -> tuple[bool, float, F64, Bool]:
    """True if the homography fits better, R_H, the chosen matrix, and its inliers (n,)."""
    h, h_score, h_in = two_view_models.homography(uv_a, uv_b, _DRAWS, _SIGMA_PX, seed)
    f, f_score, f_in = two_view_models.fundamental(uv_a, uv_b, _DRAWS, _SIGMA_PX, seed)
    ratio = h_score / max(h_score + f_score, 1e-9)
    flat = ratio > _FLAT_RATIO
    return (True, ratio, h, h_in) if flat else (False, ratio, f, f_in)


def _fundamental_motions(f: F64, matrix: F64) -> list[F64]:
    """The four T_b_a of x_b' F x_a = 0 (R. Hartley, A. Zisserman, "Multiple view geometry", result 9.19)."""
    u, _, vt = np.linalg.svd(matrix.T @ f @ matrix)
    w = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    out = []
    for turn in (u @ w @ vt, u @ w.T @ vt):
        turn = turn * np.sign(np.linalg.det(turn))
        out += [se3.from_rt(turn, u[:, 2]), se3.from_rt(turn, -u[:, 2])]
    return out


def _homography_motions(h: F64, matrix: F64) -> list[F64]:
    """T_b_a of x_b = H x_a up to scale (E. Malis, M. Vargas, "Deeper understanding of the homography", 2007)."""
    _, turns, moves, _ = cv2.decomposeHomographyMat(h, matrix)
    out = []
    for turn, move in zip(turns, moves, strict=True):
        length = float(np.linalg.norm(move))
        if length > 1e-6:
            out.append(se3.from_rt(np.asarray(turn, np.float64), np.asarray(move, np.float64).ravel() / length))
    return out or [se3.from_rt(np.eye(3), np.array([1.0, 0.0, 0.0]))]


def _depths(T_b_a: F64, uv_a: F64, uv_b: F64, fitted: Bool, camera: F64) -> tuple[F64, Bool]:
    """Triangulated points (n,3) in a, and which lie in front of both views with a small reprojection error."""
    n = len(uv_a)
    lens, T_a_b = np.tile(camera, (n, 1)), se3.inverse(T_b_a)
    places = np.tile(np.eye(4), (n, 1, 1)), np.tile(T_a_b, (n, 1, 1))
    lines = [rays(uv, lens, T) for uv, T in zip((uv_a, uv_b), places, strict=True)]
    points, front = nearest_point(
        np.stack([lines[0][0], lines[1][0]], 1), np.stack([lines[0][1], lines[1][1]], 1)
    )  # fmt: skip
    front = front & fitted
    for uv, T in zip((uv_a, uv_b), places, strict=True):
        pixel, depth = project(points, lens, T)
        front &= (depth > 0.0) & (np.linalg.norm(pixel - uv, axis=1) < _REPROJECTION_PX)
    return points, np.asarray(front)


def _refined(
    T_b_a: F64, points: F64, front: Bool, uv_a: F64, uv_b: F64, camera: F64, flat: bool, ratio: float
) -> TwoView | None:  # fmt: skip
    """Bundle adjustment of the two views, rescaled to a distance of 1; None if parallax or points are too few."""
    rows = np.flatnonzero(front)
    m = 2 * len(rows)
    measured = np.full((m, 3), -1.0)
    measured[0::2, :2], measured[1::2, :2] = uv_a[rows], uv_b[rows]
    result = bundle(
        BundleProblem(
            np.stack([np.eye(4), T_b_a]), np.tile(np.append(camera, 1.0), (2, 1)), np.array([False, True]),
            points[rows], np.arange(0, m + 1, 2, dtype=np.int32), np.tile(np.arange(2, dtype=np.int32), len(rows)),
            measured, np.full((m, 2), _SIGMA_PX),
        ),
        BundleConfig(),
    )  # fmt: skip
    T = result.T_c_m[1]
    length = float(np.linalg.norm(T[:3, 3]))
    if not (np.isfinite(result.points).all() and length > 1e-6):
        return None
    T = se3.from_rt(T[:3, :3], T[:3, 3] / length)
    refined = np.zeros_like(points)
    refined[rows] = result.points / length
    origins = np.tile(se3.inverse(T)[:3, 3], (len(points), 1))
    angle = np.arccos(np.clip(parallax(np.zeros_like(points), origins, refined), -1.0, 1.0))
    good = np.zeros(len(points), np.bool_)
    good[rows] = result.inlier.reshape(-1, 2).all(axis=1) & (refined[rows, 2] > 0.0)
    good &= angle > _MIN_POINT_PARALLAX_RAD
    if np.count_nonzero(good) < MIN_POINTS:
        return None
    typical = float(np.median(angle[good]))
    return None if typical < _MIN_PARALLAX_RAD else TwoView(T, refined, good, flat, ratio)

"""Kernels that compare the disparities of landmarks in two frames with the parallax between them."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.jit import njit

UNKNOWNS = 11  # pose (left perturbation [translation, rotation]), then five terms of the disparity offset
_SIZE = UNKNOWNS + 2  # of a row: derivatives by the unknowns and by the point's inverse depth, residual
_ROBUST = 9.0  # squared error of a point, four residuals, beyond which it weighs less


@njit
def linearise_pair(
    uv: F64, disparity: F64, sigma_px: F64, seen: F64, T: F64, camera: F64, offset: F64, rho: F64, system: F64,
    point: F64,
) -> float:  # fmt: skip
    """Normal equations of the pose between two frames and the disparity offset, with the points' depths eliminated.

    uv (n,2), disparity (n,): px in the first frame, the latter as measured. sigma_px (n,): of all coordinates. seen
    (n,3): u, v, disparity in the second, negative if not measured. T (4,4): first frame in the second. camera: fx, fy,
    cx, cy, bf. offset (5,): px, factors of 1, x, y, x^2, x y (`disparity_offset`). rho (n,): inverse depths in the
    first frame. Out: system (11,12): matrix, and right-hand side with the sign of the step. point (n,12): what
    `move_points` needs. Returns the mean squared error.
    """
    fx, fy, cx, cy, bf = camera[0], camera[1], camera[2], camera[3], camera[4]
    row = np.zeros((4, _SIZE))
    by_q = np.zeros((4, 3))
    r, total = UNKNOWNS + 1, 0.0
    for a in range(UNKNOWNS):
        for b in range(UNKNOWNS + 1):
            system[a, b] = 0.0
    for i in range(uv.shape[0]):
        x0, y0 = (uv[i, 0] - cx) / fx, (uv[i, 1] - cy) / fy
        x1, y1 = (seen[i, 0] - cx) / fx, (seen[i, 1] - cy) / fy
        qx = T[0, 0] * x0 + T[0, 1] * y0 + T[0, 2] + rho[i] * T[0, 3]
        qy = T[1, 0] * x0 + T[1, 1] * y0 + T[1, 2] + rho[i] * T[1, 3]
        qz = T[2, 0] * x0 + T[2, 1] * y0 + T[2, 2] + rho[i] * T[2, 3]
        for a in range(UNKNOWNS + 1):
            point[i, a] = 0.0
        if qz < 0.05:
            continue
        iz = 1.0 / qz
        by_q[1, 0], by_q[1, 2] = fx * iz, -fx * qx * iz * iz
        by_q[2, 1], by_q[2, 2] = fy * iz, -fy * qy * iz * iz
        by_q[3, 2] = -bf * rho[i] * iz * iz
        row[0, 6], row[0, 7], row[0, 8], row[0, 9], row[0, 10] = 1.0, x0, y0, x0 * x0, x0 * y0
        row[3, 6], row[3, 7], row[3, 8], row[3, 9], row[3, 10] = 1.0, x1, y1, x1 * x1, x1 * y1
        row[0, r] = bf * rho[i] - disparity[i]
        row[1, r] = fx * qx * iz + cx - seen[i, 0]
        row[2, r] = fy * qy * iz + cy - seen[i, 1]
        row[3, r] = bf * rho[i] * iz - seen[i, 2]
        for a in range(5):
            row[0, r] += row[0, 6 + a] * offset[a]
            row[3, r] += row[3, 6 + a] * offset[a]
        row[0, r - 1] = bf
        for k in range(1, 4):
            a, b, c = by_q[k, 0], by_q[k, 1], by_q[k, 2]
            row[k, 0], row[k, 1], row[k, 2] = a * rho[i], b * rho[i], c * rho[i]
            row[k, 3], row[k, 4], row[k, 5] = c * qy - b * qz, a * qz - c * qx, b * qx - a * qy
            row[k, r - 1] = a * T[0, 3] + b * T[1, 3] + c * T[2, 3]
        row[3, r - 1] += bf * iz
        rows = 4 if seen[i, 2] >= 0.0 else 3
        weight, square, hr = 1.0 / (sigma_px[i] * sigma_px[i]), 0.0, 0.0
        for k in range(rows):
            square += row[k, r] * row[k, r] * weight
            hr += row[k, r - 1] * row[k, r - 1]
        total += min(square, _ROBUST)
        if square > _ROBUST:
            weight *= _ROBUST / square
        for a in range(UNKNOWNS):
            t = 0.0
            for k in range(rows):
                t += row[k, a] * row[k, r - 1]
            point[i, a] = t / hr
        t = 0.0
        for k in range(rows):
            t += row[k, r] * row[k, r - 1]
        point[i, UNKNOWNS] = t / hr
        for a in range(UNKNOWNS):
            for b in range(a + 1):
                t = -point[i, a] * point[i, b] * hr
                for k in range(rows):
                    t += row[k, a] * row[k, b]
                system[a, b] += weight * t
            t = -point[i, a] * point[i, UNKNOWNS] * hr
            for k in range(rows):
                t += row[k, a] * row[k, r]
            system[a, UNKNOWNS] -= weight * t
    for a in range(UNKNOWNS):
        for b in range(a):
            system[b, a] = system[a, b]
    return float(total / max(uv.shape[0], 1))


@njit
def move_points(point: F64, step: F64, least: float, rho: F64) -> None:
    """Inverse depths (n,) after a step (11,) of pose and offset; point as `linearise_pair` left it."""
    for i in range(rho.shape[0]):
        t = point[i, UNKNOWNS]
        for a in range(UNKNOWNS):
            t += point[i, a] * step[a]
        rho[i] = max(rho[i] - t, least)

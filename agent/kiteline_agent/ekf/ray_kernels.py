"""Kernels that position a landmark by its rays, and find the rays that agree."""

import numpy as np

from kiteline_core.arrays import F64, Bool
from kiteline_core.jit import helper, njit

_STEPS = 2  # Gauss-Newton steps after the linear solution: it is near
_STILL = 1e-3  # of the distance: after a shorter step the next one would be a thousand times shorter


@helper
def _solve(a: F64, b: F64, x: F64) -> bool:
    """Solve a symmetric 3x3 system, of which the upper triangle is read, by cofactors; False if it is singular."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    det = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    largest = a[0, 0] + a[1, 1] + a[2, 2]
    if not det > 1e-12 * largest * largest * largest:
        return False
    c11 = a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]
    c12 = a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]
    c22 = a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]
    x[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / det
    x[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / det
    x[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / det
    return True


@njit
def position_by_rays(xy: F64, T_o_c: F64, point: F64) -> bool:
    """Set the point (3,) nearest to the rays; False if it is not determined, or lies behind a camera.

    First the point nearest to all rays, by linear least squares, then that of least reprojection error. xy: (v,2) x/z,
    y/z in cameras T_o_c (v,4,4).
    """
    a = np.zeros((3, 3))
    b = np.zeros(3)
    d = np.empty(3)
    for k in range(len(xy)):
        length = np.sqrt(xy[k, 0] ** 2 + xy[k, 1] ** 2 + 1.0)
        along = 0.0
        for i in range(3):
            d[i] = (T_o_c[k, i, 0] * xy[k, 0] + T_o_c[k, i, 1] * xy[k, 1] + T_o_c[k, i, 2]) / length
            along += d[i] * T_o_c[k, i, 3]
        for i in range(3):
            b[i] += T_o_c[k, i, 3] - along * d[i]
            for j in range(i, 3):
                a[i, j] += (1.0 if i == j else 0.0) - d[i] * d[j]
    if not _solve(a, b, point):
        return False
    step = np.empty(3)
    for _ in range(_STEPS):
        a[:] = 0.0
        b[:] = 0.0
        for k in range(len(xy)):
            x = y = z = 0.0
            for i in range(3):
                off = point[i] - T_o_c[k, i, 3]
                x += T_o_c[k, i, 0] * off
                y += T_o_c[k, i, 1] * off
                z += T_o_c[k, i, 2] * off
            if z < 1e-3:
                return False
            for r in range(2):
                ahead = (x if r == 0 else y) / z
                error = xy[k, r] - ahead
                for i in range(3):
                    d[i] = (T_o_c[k, i, r] - T_o_c[k, i, 2] * ahead) / z
                for i in range(3):
                    b[i] += d[i] * error
                    for j in range(i, 3):
                        a[i, j] += d[i] * d[j]
        if not _solve(a, b, step):
            return False
        moved = far = 0.0
        for i in range(3):
            point[i] += step[i]
            moved += step[i] * step[i]
            far += (point[i] - T_o_c[0, i, 3]) ** 2
        if moved < _STILL * _STILL * far:
            break
    return True


@njit
def supporting_views(centres: F64, rays: F64, seen: Bool, tolerance: float, best: Bool) -> None:
    """Which views agree with the last one on a point; rays far from it are wrong matches.

    Each other view in turn gives a point with the last one; the one with most rays near it counts.
    centres: (v,3). rays: (n,v,3) unit directions. seen: (n,v). tolerance: rad. best: (n,v), set.
    """
    n, v = seen.shape
    a = np.empty((3, 3))
    b, point = np.empty(3), np.empty(3)
    near = np.empty(v, np.bool_)
    for k in range(n):
        most = 0
        best[k] = False
        for other in range(v - 1):
            if not seen[k, other]:
                continue
            a[:] = 0.0
            b[:] = 0.0
            for view in (other, v - 1):
                d, centre = rays[k, view], centres[view]
                along = d[0] * centre[0] + d[1] * centre[1] + d[2] * centre[2]
                for i in range(3):
                    b[i] += centre[i] - along * d[i]
                    for j in range(i, 3):
                        a[i, j] += (1.0 if i == j else 0.0) - d[i] * d[j]
            if not _solve(a, b, point):
                continue
            count = 0
            for view in range(v):
                d, centre = rays[k, view], centres[view]
                along = square = 0.0
                for i in range(3):
                    along += (point[i] - centre[i]) * d[i]
                for i in range(3):
                    off = point[i] - centre[i] - along * d[i]
                    square += off * off
                near[view] = seen[k, view] and along > 0.0 and square < (tolerance * along) ** 2
                count += near[view]
            if near[v - 1] and count > most:
                most = count
                best[k] = near

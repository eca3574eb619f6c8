"""Kernels that rectify small parts of a raw image, from a grid of raw pixels (`Rectifier.left_grid`, `right_grid`)."""

from __future__ import annotations

import numpy as np

from kiteline_core.geometry.cameras import GRID_STEP
from kiteline_core.jit import njit

SIDE = 14  # px of a rectified patch: 10 px for a bilinear 9x9 patch, and room to move by 2 px each way
ROOM = 2


@njit
def _raw_at(grid, x, y):  # type: ignore[no-untyped-def]
    """Raw pixel of the rectified pixel (x, y). grid: (gh,gw,2) float32, every GRID_STEP px."""
    gx = min(max(x * (1.0 / GRID_STEP), 0.0), grid.shape[1] - 1.001)
    gy = min(max(y * (1.0 / GRID_STEP), 0.0), grid.shape[0] - 1.001)
    x0 = int(gx)
    y0 = int(gy)
    fx = gx - x0
    fy = gy - y0
    w00 = (1.0 - fx) * (1.0 - fy)
    w01 = fx * (1.0 - fy)
    w10 = (1.0 - fx) * fy
    w11 = fx * fy
    u = w00 * grid[y0, x0, 0] + w01 * grid[y0, x0 + 1, 0] + w10 * grid[y0 + 1, x0, 0] + w11 * grid[y0 + 1, x0 + 1, 0]
    v = w00 * grid[y0, x0, 1] + w01 * grid[y0, x0 + 1, 1] + w10 * grid[y0 + 1, x0, 1] + w11 * grid[y0 + 1, x0 + 1, 1]
    return u, v


@njit
def _rectify_patch(image, grid, left, top, patch):  # type: ignore[no-untyped-def]
    """Fill patch (SIDE, SIDE) uint8 with the rectified pixels from (left, top) on; False outside of the raw image.

    Distortion along a row is a parabola through three pixels.
    """
    h, w = image.shape
    last = SIDE - 1.0
    for r in range(SIDE):
        x = float(left)
        y = float(top + r)
        u0, v0 = _raw_at(grid, x, y)
        u1, v1 = _raw_at(grid, x + 0.5 * last, y)
        u2, v2 = _raw_at(grid, x + last, y)
        if min(u0, u1, u2) < 0.0 or max(u0, u1, u2) >= w - 1.5 or min(v0, v1, v2) < 0.0 or max(v0, v1, v2) >= h - 1.5:
            return False
        bu, bv = (4.0 * u1 - 3.0 * u0 - u2) / last, (4.0 * v1 - 3.0 * v0 - v2) / last
        cu, cv = 2.0 * (u0 - 2.0 * u1 + u2) / (last * last), 2.0 * (v0 - 2.0 * v1 + v2) / (last * last)
        for c in range(SIDE):
            px = u0 + c * (bu + c * cu)
            py = v0 + c * (bv + c * cv)
            x0 = np.uint64(max(px, 0.0))
            y0 = np.uint64(max(py, 0.0))
            fx = px - x0
            fy = py - y0
            a = float(image[y0, x0])
            b = float(image[y0 + np.uint64(1), x0])
            top_row = a + fx * (float(image[y0, x0 + np.uint64(1)]) - a)
            bottom_row = b + fx * (float(image[y0 + np.uint64(1), x0 + np.uint64(1)]) - b)
            patch[r, c] = np.uint8(top_row + fy * (bottom_row - top_row) + 0.5)
    return True

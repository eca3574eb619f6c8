"""Kernels that rectify small parts of a raw image, from a grid of raw pixels (`Rectifier.left_grid`, `right_grid`)."""

from __future__ import annotations

import numpy as np

from kiteline_core.geometry.cameras import GRID_STEP
from kiteline_core.jit import njit

SIDE = 14  # px of a rectified patch: 10 px for a bilinear 9x9 patch, and room to move by 2 px each way
ROOM = 2
FIXED = 4294967296.0  # steps per px of a position
HALF = 1 << 24  # half of 1/128 px: positions are rounded


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

    Distortion is a parabola in each direction, through three by three pixels.
    """
    h, w = image.shape
    last = SIDE - 1.0
    one = np.uint64(1)
    for r in range(SIDE):
        row = float(top + r)
        u0, v0 = _raw_at(grid, float(left), row)
        u1, v1 = _raw_at(grid, left + 0.5 * last, row)
        u2, v2 = _raw_at(grid, left + last, row)
        if min(u0, u1, u2) < 0.5 or max(u0, u1, u2) >= w - 2.0 or min(v0, v1, v2) < 0.5 or max(v0, v1, v2) >= h - 2.0:
            return False
        # Positions by second differences, in 2^-32 px; pixels in 1/128 of the way to the next.
        cu = 2.0 * (u0 - 2.0 * u1 + u2) / (last * last)
        cv = 2.0 * (v0 - 2.0 * v1 + v2) / (last * last)
        x = np.int64(u0 * FIXED) + HALF
        y = np.int64(v0 * FIXED) + HALF
        step_x = np.int64(((4.0 * u1 - 3.0 * u0 - u2) / last + cu) * FIXED)
        step_y = np.int64(((4.0 * v1 - 3.0 * v0 - v2) / last + cv) * FIXED)
        bend_x = np.int64(2.0 * cu * FIXED)
        bend_y = np.int64(2.0 * cv * FIXED)
        out = patch[r]
        for k in range(SIDE):
            x0 = np.uint64(x >> 32)
            y0 = np.uint64(y >> 32)
            fx = (x >> 25) & 127
            fy = (y >> 25) & 127
            a = np.int64(image[y0, x0])
            b = np.int64(image[y0 + one, x0])
            above = (a << 7) + fx * (np.int64(image[y0, x0 + one]) - a)
            below = (b << 7) + fx * (np.int64(image[y0 + one, x0 + one]) - b)
            out[np.uint64(k)] = np.uint8(((above << 7) + fy * (below - above) + 8192) >> 14)
            x += step_x
            y += step_y
            step_x += bend_x
            step_y += bend_y
    return True

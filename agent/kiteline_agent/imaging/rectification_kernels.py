"""Kernels that rectify small parts of a raw image, from a grid of raw pixels (`Rectifier.left_grid`, `right_grid`)."""

import numpy as np

from kiteline_core.geometry.cameras import GRID_STEP
from kiteline_core.jit import njit

SIDE = 14  # px of a patch in which another is moved: 10 px for a bilinear 9x9 patch, and 2 px each way
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
def _differences(a, b, c, part):  # type: ignore[no-untyped-def]
    """A parabola in steps of `part` of its length: first value, first and second difference. a, b, c: its values at
    begin, middle and end.
    """
    bend = 4.0 * (a - 2.0 * b + c) * part * part
    return np.int64(a), np.int64((4.0 * b - 3.0 * a - c) * part + 0.5 * bend), np.int64(bend)


@njit
def _rectify_patch(image, grid, scale, left, top, rows, columns, bits, out, stretch=1.0, shear=0.0):  # type: ignore[no-untyped-def]
    """Fill out[:columns, :rows] with the rectified pixels from (left, top) on; False outside of the raw image.

    image: raw, of the pyramid's level whose pixels are `scale` px wide; left, top: px of it. bits: of 14, by which grey
    levels are shortened. Distortion is a parabola in each direction, through three by three pixels. stretch: px between
    two columns. shear: px by which each row begins farther to the right than the one above it, about the middle row.
    """
    h, w = image.shape
    one = np.uint64(1)
    last = columns - 1.0
    inverse = 1.0 / scale
    half_x = 0.5 * last * scale * stretch
    half_y = 0.5 * (rows - 1.0) * scale
    x1 = left * scale
    x0 = x1 - shear * half_y
    x2 = x1 + shear * half_y
    y0 = top * scale
    u00, v00 = _raw_at(grid, x0, y0)
    u01, v01 = _raw_at(grid, x0 + half_x, y0)
    u02, v02 = _raw_at(grid, x0 + 2.0 * half_x, y0)
    u10, v10 = _raw_at(grid, x1, y0 + half_y)
    u11, v11 = _raw_at(grid, x1 + half_x, y0 + half_y)
    u12, v12 = _raw_at(grid, x1 + 2.0 * half_x, y0 + half_y)
    u20, v20 = _raw_at(grid, x2, y0 + 2.0 * half_y)
    u21, v21 = _raw_at(grid, x2 + half_x, y0 + 2.0 * half_y)
    u22, v22 = _raw_at(grid, x2 + 2.0 * half_x, y0 + 2.0 * half_y)
    if min(u00, u10, u20) * inverse < 0.5 or max(u02, u12, u22) * inverse >= w - 2.0:
        return False
    if min(v00, v01, v02) * inverse < 0.5 or max(v20, v21, v22) * inverse >= h - 2.0:
        return False
    # Positions by differences along rows, and those by differences from row to row, in 2^-32 px; pixels in 1/128 of the
    # way to the next.
    fixed = inverse * FIXED
    part = 1.0 / last
    down = 1.0 / (rows - 1.0)
    x_row, dx_row, ddx_row = _differences(u00 * fixed, u10 * fixed, u20 * fixed, down)
    y_row, dy_row, ddy_row = _differences(v00 * fixed, v10 * fixed, v20 * fixed, down)
    _, step0, _ = _differences(u00 * fixed, u01 * fixed, u02 * fixed, part)
    _, step1, bend_x = _differences(u10 * fixed, u11 * fixed, u12 * fixed, part)
    _, step2, _ = _differences(u20 * fixed, u21 * fixed, u22 * fixed, part)
    step_x_row, dstep_x, ddstep_x = _differences(float(step0), float(step1), float(step2), down)
    _, step0, _ = _differences(v00 * fixed, v01 * fixed, v02 * fixed, part)
    _, step1, bend_y = _differences(v10 * fixed, v11 * fixed, v12 * fixed, part)
    _, step2, _ = _differences(v20 * fixed, v21 * fixed, v22 * fixed, part)
    step_y_row, dstep_y, ddstep_y = _differences(float(step0), float(step1), float(step2), down)
    rounding = np.int64(1) << (bits - 1)
    for r in range(rows):
        x, y, step_x, step_y = x_row + HALF, y_row + HALF, step_x_row, step_y_row
        to = np.uint64(r)
        for k in range(columns):
            column = np.uint64(x >> 32)
            row = np.uint64(y >> 32)
            fx = (x >> 25) & 127
            fy = (y >> 25) & 127
            a = np.int64(image[row, column])
            b = np.int64(image[row + one, column])
            above = (a << 7) + fx * (np.int64(image[row, column + one]) - a)
            below = (b << 7) + fx * (np.int64(image[row + one, column + one]) - b)
            out[np.uint64(k), to] = ((above << 7) + fy * (below - above) + rounding) >> bits
            x += step_x
            y += step_y
            step_x += bend_x
            step_y += bend_y
        x_row += dx_row
        y_row += dy_row
        dx_row += ddx_row
        dy_row += ddy_row
        step_x_row += dstep_x
        step_y_row += dstep_y
        dstep_x += ddstep_x
        dstep_y += ddstep_y
    return True

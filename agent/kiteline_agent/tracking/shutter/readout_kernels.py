"""What one frame tells of a rolling shutter's read-out: the normal equations of `readout.py`."""

import numpy as np

from kiteline_core.geometry.cameras import GRID_STEP
from kiteline_core.jit import njit
from kiteline_core.pose.pose_kernels import solve6

_DEPTH_SIGMA = 0.1  # of a landmark's depth, relative: only errors across the epipolar line count
_ROBUST = 9.0  # squared deviations at which an observation counts half: the shutter itself moves pixels by several
_LEAST = 12  # landmarks of a keyframe whose relative pose is an unknown


@njit
def _raw_row(u, v, grid):  # type: ignore[no-untyped-def]
    """The row of the raw image that shows a rectified pixel, as in RollingShutter. grid: NO_GRID if none is needed."""
    if grid.shape[0] == 0:
        return v
    column = min(max(int(np.rint(u / GRID_STEP)), 0), grid.shape[1] - 1)
    line = min(max(int(np.rint(v / GRID_STEP)), 0), grid.shape[0] - 1)
    return grid[line, column, 1] + (v - GRID_STEP * line)


@njit
def row_shift(u, v, rho, twist, camera, height, grid):  # type: ignore[no-untyped-def]
    """Shift in px for each second of read-out from where a frame's stamp has a pixel to where its row shows it.

    u, v: px. rho: inverse depth, 1/m. twist: (6,) of the camera in its own axes, m/s, rad/s. camera: fx, fy, cx, cy.
    """
    x, y = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
    share = min(max((_raw_row(u, v, grid) + 0.5) / height, 0.0), 1.0) - 0.5
    along = twist[3] * y - twist[4] * x + twist[2] * rho
    flow_x = twist[4] - twist[5] * y + twist[0] * rho - x * along
    flow_y = twist[5] * x - twist[3] + twist[1] * rho - y * along
    return -share * camera[0] * flow_x, -share * camera[1] * flow_y


@njit
def readout_equation(  # type: ignore[no-untyped-def]
    T_c_m, camera, height, grid, twist, rows, observed, octave, warp, parallax, T_m_k, bearing, rho, twists
):
    """Information and gradient of the read-out, in px^2/s^2 and px^2/s, from one frame's observations.

    A pixel differs from where the map has it by the read-out times its own row's shift, less that of its keyframe's,
    as the frame sees it. The pose relative to each keyframe is unknown: it took up what the shutter did to both.

    T_c_m: (4,4). camera: fx, fy, cx, cy. height: rows of the raw image. twist: (6,) of this frame. rows: (n,)
    slot*B+index. observed: (n,2) px. octave: (n,). warp, parallax: of `projection_kernels.views`. T_m_k: (K,4,4).
    bearing: (K,B,2). rho: (K,B). twists: (K,6) of the keyframes' images; NaN: unknown.
    """
    slots, size = bearing.shape[0], bearing.shape[1]
    h, g, hg = np.zeros((slots, 6, 6)), np.zeros((slots, 6)), np.zeros((slots, 6))
    information, gradient, count = np.zeros(slots), np.zeros(slots), np.zeros(slots, np.int64)
    jacobian, world, point = np.empty((2, 6)), np.empty(3), np.empty(3)
    for j in range(rows.shape[0]):
        k, i = rows[j] // size, rows[j] % size
        if np.isnan(twists[k, 0]):
            continue
        bx, by, p = bearing[k, i, 0], bearing[k, i, 1], rho[k, i]
        for a in range(3):
            world[a] = T_m_k[k, a, 3] + (T_m_k[k, a, 0] * bx + T_m_k[k, a, 1] * by + T_m_k[k, a, 2]) / p
        for a in range(3):
            point[a] = T_c_m[a, 0] * world[0] + T_c_m[a, 1] * world[1] + T_c_m[a, 2] * world[2] + T_c_m[a, 3]
        x, y, z = point[0], point[1], point[2]
        if z < 0.05:
            continue
        fx, fy, iz = camera[0], camera[1], 1.0 / z
        rx = observed[j, 0] - (fx * x * iz + camera[2])
        ry = observed[j, 1] - (fy * y * iz + camera[3])
        # by the read-out
        gx, gy = row_shift(observed[j, 0], observed[j, 1], iz, twist, camera, height, grid)
        u_k, v_k = bx * fx + camera[2], by * fy + camera[3]
        kx, ky = row_shift(u_k, v_k, p, twists[k], camera, height, grid)
        gx -= warp[j, 0, 0] * kx + warp[j, 0, 1] * ky
        gy -= warp[j, 1, 0] * kx + warp[j, 1, 1] * ky
        # by a small motion [translation, rotation] of the camera frame: p' = p + v + w x p
        ax, ay, bx_z, by_z = fx * iz, fy * iz, -fx * x * iz * iz, -fy * y * iz * iz
        jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = ax, 0.0, bx_z
        jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = 0.0, ay, by_z
        jacobian[0, 3], jacobian[0, 4], jacobian[0, 5] = bx_z * y, ax * z - bx_z * x, -ax * y
        jacobian[1, 3], jacobian[1, 4], jacobian[1, 5] = by_z * y - ay * z, -by_z * x, ay * x
        # weights: 1 px of the octave, and the depth's error along the epipolar line
        s2 = float(1 << (2 * octave[j]))
        vx, vy = _DEPTH_SIGMA * parallax[j, 0], _DEPTH_SIGMA * parallax[j, 1]
        spread = 1.0 / (s2 + vx * vx + vy * vy)
        across = rx * vx + ry * vy
        e2 = (rx * rx + ry * ry - across * across * spread) / s2
        weight = 1.0 / (s2 * (1.0 + e2 / _ROBUST))
        w00, w01, w11 = weight * (1.0 - vx * vx * spread), -weight * vx * vy * spread, weight * (1.0 - vy * vy * spread)
        count[k] += 1
        qx, qy = w00 * gx + w01 * gy, w01 * gx + w11 * gy
        information[k] += gx * qx + gy * qy
        gradient[k] += rx * qx + ry * qy
        for a in range(6):
            la = w00 * jacobian[0, a] + w01 * jacobian[1, a]
            lb = w01 * jacobian[0, a] + w11 * jacobian[1, a]
            g[k, a] += la * rx + lb * ry
            hg[k, a] += la * gx + lb * gy
            for b in range(a + 1):
                h[k, a, b] += la * jacobian[0, b] + lb * jacobian[1, b]
    all_information = all_gradient = 0.0
    free = np.empty(6)
    for k in range(slots):
        if count[k] < _LEAST:
            continue
        for a in range(6):
            h[k, a, a] += 1e-6
        if not solve6(h[k], hg[k], free):
            continue
        all_information += information[k]
        all_gradient += gradient[k]
        for a in range(6):
            all_information -= hg[k, a] * free[a]
            all_gradient -= g[k, a] * free[a]
    return all_information, all_gradient

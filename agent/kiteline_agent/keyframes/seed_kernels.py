"""Kernels of landmarks without depth: where they may be in a frame, and their depth where they were found."""

import numpy as np

from kiteline_core.jit import helper, njit

_NEAREST = 0.05  # of a depth: a point nearer to the camera, or behind it, is taken far out on its side
_LEAST_RHO = 1e-6  # of an inverse depth in 1/m


@helper
def _pixel(direction, centre, camera, rho, least_z):  # type: ignore[no-untyped-def]
    """Pixel of a landmark at an inverse depth: (direction + centre * rho) / rho in the camera; and z of the former."""
    x, y, z = direction[0] + centre[0] * rho, direction[1] + centre[1] * rho, direction[2] + centre[2] * rho
    near = max(z, least_z)
    return x / near * camera[0] + camera[2], y / near * camera[1] + camera[3], z


@njit
def seed_segments(  # type: ignore[no-untyped-def]
    T_c_m, camera, rows, T_m_k, bearing, rho, sigma, reach, ceiling, direction, centre, start, end
):
    """Rays of seeds in a camera at T_c_m (4,4), and the segments of the image in which they lie.

    camera: fx, fy, cx, cy, … px. rows: (n,) slot*B+index. T_m_k: (K,4,4). bearing: (K,B,2) x/z, y/z. rho, sigma: (n,)
    inverse depth and its deviation, 1/m. reach: deviations to both sides; ceiling: 1/m of the nearest end.
    Out, (n,3): direction, and centre of the keyframe, both in the camera; (n,2): start and end, px at level 0.
    """
    slot_size = bearing.shape[1]
    for i in range(len(rows)):
        k, j = rows[i] // slot_size, rows[i] % slot_size
        x, y = bearing[k, j, 0], bearing[k, j, 1]
        ray = (
            T_m_k[k, 0, 0] * x + T_m_k[k, 0, 1] * y + T_m_k[k, 0, 2],
            T_m_k[k, 1, 0] * x + T_m_k[k, 1, 1] * y + T_m_k[k, 1, 2],
            T_m_k[k, 2, 0] * x + T_m_k[k, 2, 1] * y + T_m_k[k, 2, 2],
        )
        for a in range(3):
            u, v, w = T_c_m[a, 0], T_c_m[a, 1], T_c_m[a, 2]
            direction[i, a] = u * ray[0] + v * ray[1] + w * ray[2]
            centre[i, a] = u * T_m_k[k, 0, 3] + v * T_m_k[k, 1, 3] + w * T_m_k[k, 2, 3] + T_c_m[a, 3]
        far, near = max(rho[i] - reach * sigma[i], _LEAST_RHO), min(rho[i] + reach * sigma[i], ceiling)
        start[i, 0], start[i, 1], _ = _pixel(direction[i], centre[i], camera, far, _NEAREST)
        end[i, 0], end[i, 1], _ = _pixel(direction[i], centre[i], camera, near, _NEAREST)


@njit
def intersect(direction, centre, uv, octave, camera, sigma_px, rho, variance, off_px):  # type: ignore[no-untyped-def]
    """Inverse depths (n,) of seeds that come nearest to their pixels (n,2), by least squares.

    direction, centre, camera: see `seed_segments`. octave: (n,). sigma_px: of a pixel at octave 0.
    Out, (n,): rho 1/m, its variance, infinite next to or behind the camera, and px off the epipolar line.
    """
    for i in range(len(uv)):
        c = centre[i]
        across_x, across_y = (uv[i, 0] - camera[2]) / camera[0], (uv[i, 1] - camera[3]) / camera[1]
        gain_x, gain_y = c[0] - across_x * c[2], c[1] - across_y * c[2]
        want_x, want_y = across_x * direction[i, 2] - direction[i, 0], across_y * direction[i, 2] - direction[i, 1]
        found = (gain_x * want_x + gain_y * want_y) / max(gain_x * gain_x + gain_y * gain_y, 1e-18)
        u, v, z = _pixel(direction[i], c, camera, found, 1e-3)
        near = max(z, 1e-3)
        slope_x = (camera[0] * c[0] - (u - camera[2]) * c[2]) / near  # px per 1/m
        slope_y = (camera[1] * c[1] - (v - camera[3]) * c[2]) / near
        square, sigma = slope_x * slope_x + slope_y * slope_y, sigma_px * (1 << octave[i])
        rho[i] = found
        variance[i] = sigma * sigma / square if z > _NEAREST and square > 0.0 else np.inf
        off_px[i] = np.hypot(u - uv[i, 0], v - uv[i, 1])

"""The initialisation that the paper compares with: particles along a landmark's first ray."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.jit import njit


@njit
def position_by_particles(xy: F64, T_o_c: F64, sigma: float, range_m: float, count: int, point: F64) -> None:
    """Set the most probable particle (3,) of those spread evenly along the first ray, up to a range.

    xy: (v,2) x/z, y/z in cameras T_o_c (v,4,4), of deviation sigma. Each later observation weighs the particles by its
    likelihood. Source: Zhang et al., 2008, as "Monocular EKF-SLAM with delayed landmark initialisation" describes it.
    """
    length = np.sqrt(xy[0, 0] ** 2 + xy[0, 1] ** 2 + 1.0)
    place = np.empty((count, 3))
    weight = np.full(count, 1.0 / count)
    for n in range(count):
        far = range_m * (n + 1) / count / length
        for i in range(3):
            place[n, i] = (
                T_o_c[0, i, 3] + far * (T_o_c[0, i, 0] * xy[0, 0] + T_o_c[0, i, 1] * xy[0, 1] + T_o_c[0, i, 2])
            )  # fmt: skip
    for k in range(1, len(xy)):
        total = 0.0
        for n in range(count):
            x = y = z = 0.0
            for i in range(3):
                off = place[n, i] - T_o_c[k, i, 3]
                x += T_o_c[k, i, 0] * off
                y += T_o_c[k, i, 1] * off
                z += T_o_c[k, i, 2] * off
            if z < 1e-3:
                weight[n] = 0.0
                continue
            square = (x / z - xy[k, 0]) ** 2 + (y / z - xy[k, 1]) ** 2
            weight[n] *= np.exp(-0.5 * square / (sigma * sigma)) + 1e-12
            total += weight[n]
        if total == 0.0:  # the camera has passed all particles
            break
        for n in range(count):
            weight[n] /= total
    best = 0
    for n in range(count):
        if weight[n] > weight[best]:
            best = n
    for i in range(3):
        point[i] = place[best, i]

"""Kernel of the integrals of IMU samples over a window, linear in the calibration of the accelerometer."""

import numpy as np

from kiteline_agent.inertial.imu_kernels import copy33, mul33, so3_exp
from kiteline_core.arrays import F64
from kiteline_core.jit import njit


@njit
def integrate_window(
    t_s: F64, gyro: F64, accel: F64, matrix: F64, bias: F64, turn: F64, by_rate: F64, by_force: F64, time: F64
) -> None:
    """Integrals of raw samples in the body frame of the first one, R being the rotation to it.

    t_s: (n,) s. gyro, accel: (n,3) raw. matrix (3,3), bias (3,): rate = matrix @ gyro - bias. Out: turn (3,3) rotation
    of the last sample; by_rate (3,9) of R (x) gyro; by_force (2,3,9) of R (x) accel, with weight 1 and with one that
    grows from 0 to 1 over the window; time (2,3,3) of R with these weights. Columns of the outer products are
    row-major elements of a matrix.
    """
    n = t_s.shape[0]
    w, mean_g, mean_a = np.empty(3), np.empty(3), np.empty(3)
    step, after, middle = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            turn[i, j] = 1.0 if i == j else 0.0
            time[0, i, j] = time[1, i, j] = 0.0
        for j in range(9):
            by_rate[i, j] = by_force[0, i, j] = by_force[1, i, j] = 0.0
    for k in range(n - 1):
        dt = t_s[k + 1] - t_s[k]
        weight = 0.5 * (t_s[k + 1] + t_s[k]) / t_s[n - 1]
        for i in range(3):
            mean_g[i] = 0.5 * (gyro[k, i] + gyro[k + 1, i])
            mean_a[i] = 0.5 * (accel[k, i] + accel[k + 1, i])
        for i in range(3):
            w[i] = (matrix[i, 0] * mean_g[0] + matrix[i, 1] * mean_g[1] + matrix[i, 2] * mean_g[2] - bias[i]) * dt
        so3_exp(w, step)
        mul33(turn, step, after)
        for i in range(3):
            for j in range(3):
                middle[i, j] = 0.5 * (turn[i, j] + after[i, j]) * dt
        copy33(after, turn)
        for i in range(3):
            for j in range(3):
                r = middle[i, j]
                time[0, i, j] += r
                time[1, i, j] += weight * r
                for m in range(3):
                    by_rate[i, 3 * j + m] += r * mean_g[m]
                    by_force[0, i, 3 * j + m] += r * mean_a[m]
                    by_force[1, i, 3 * j + m] += weight * r * mean_a[m]

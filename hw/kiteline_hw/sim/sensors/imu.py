"""The samples of an IMU on the body along a path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_hw.sim.world.path import GRAVITY, Path, flight_s

START_GYRO_BIAS = 0.003  # rad/s, standard deviation of the bias at switch-on
START_ACCEL_BIAS = 0.05  # m/s^2, likewise


def measure(
    path: Path, t_ns: NDArray[np.int64], start_ns: int, calibration: ImuCalibration, seed: int, noise: bool = True
) -> ImuBatch:
    """Samples at t_ns (n,): angular rate and specific force, with white noise and random-walk biases.

    The samples of a longer flight with the same seed begin with those of a shorter one.
    """
    motion = path.motion(flight_s(t_ns, start_ns))
    force = motion.acceleration + [0.0, 0.0, GRAVITY]
    accel = np.einsum("nji,nj->ni", motion.T_w_b[:, :3, :3], force)
    gyro = motion.rate
    if noise:
        rng = np.random.default_rng([seed, 17])
        start = rng.standard_normal(6)
        white = rng.standard_normal((t_ns.shape[0], 12))
        root = np.sqrt(calibration.rate_hz)
        walk = np.cumsum(white[:, 6:], axis=0) / root
        gyro = gyro + START_GYRO_BIAS * start[:3] + calibration.gyro_noise * root * white[:, :3]
        gyro = gyro + calibration.gyro_walk * walk[:, :3]
        accel = accel + START_ACCEL_BIAS * start[3:] + calibration.accel_noise * root * white[:, 3:6]
        accel = accel + calibration.accel_walk * walk[:, 3:]
    return ImuBatch(t_ns, gyro, accel)

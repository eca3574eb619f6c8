"""The samples of an IMU on the body along a path."""

import numpy as np

from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_hw.sim.sensors.wear import ImuWear
from kiteline_hw.sim.world.path import EASE_S, GRAVITY, Path, flight_s

START_GYRO_BIAS = 0.003  # rad/s, standard deviation of the bias at switch-on
START_ACCEL_BIAS = 0.05  # m/s^2, likewise


def measure(
    path: Path, t_ns: I64, start_ns: int, calibration: ImuCalibration, seed: int, noise: bool = True,
    wear: ImuWear | None = None,
) -> ImuBatch:  # fmt: skip
    """Samples at t_ns (n,): angular rate and specific force, with white noise and random-walk biases.

    calibration: the densities of the noise; those of `wear` replace them. Samples that a worn IMU loses are left out.
    The samples of a longer flight with the same seed begin with those of a shorter one.
    """
    t_s = flight_s(t_ns, start_ns)
    motion = path.motion(t_s)
    force = motion.acceleration + [0.0, 0.0, GRAVITY]
    accel = np.einsum("nji,nj->ni", motion.T_w_b[:, :3, :3], force)
    gyro = motion.rate
    if wear is not None:
        gyro, accel = _worn(path, t_s, gyro, accel, seed, wear)
        calibration = wear.noise
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
    if wear is None:
        return ImuBatch(t_ns, gyro, accel)
    gyro, accel = np.clip(gyro, -wear.gyro_range, wear.gyro_range), np.clip(accel, -wear.accel_range, wear.accel_range)
    kept = ~_lost(len(t_ns), seed, wear)
    return ImuBatch(t_ns[kept], gyro[kept], accel[kept])


def _worn(path: Path, t_s: F64, gyro: F64, accel: F64, seed: int, wear: ImuWear) -> tuple[F64, F64]:
    """True rates and forces (n,3) with vibration, as axes with errors of scale and direction measure them."""
    flying = np.ones(len(t_s)) if path.rest_s <= 0.0 else np.clip((t_s - path.rest_s) / EASE_S, 0.0, 1.0)
    level = (wear.vibration_at_rest + (1.0 - wear.vibration_at_rest) * flying)[:, None]
    white = np.random.default_rng([seed, 19]).standard_normal((len(t_s), 6))
    gyro = gyro + level * (wear.gyro_tones.at(t_s) + wear.gyro_tones.white * white[:, :3])
    accel = accel + level * (wear.accel_tones.at(t_s) + wear.accel_tones.white * white[:, 3:])
    return gyro @ wear.gyro_matrix.T, accel @ wear.accel_matrix.T


def _lost(n: int, seed: int, wear: ImuWear) -> Bool:
    """Whether each sample (n,) is lost, singly or in a gap."""
    draws = np.random.default_rng([seed, 23]).random((n, 3))
    lost = draws[:, 0] < wear.sample_loss
    for k in np.flatnonzero(draws[:, 1] < wear.gap_chance):
        lost[k : k + max(1, round(wear.gap_samples * (0.5 + draws[k, 2])))] = True
    return np.asarray(lost)

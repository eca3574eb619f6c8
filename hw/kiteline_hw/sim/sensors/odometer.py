"""The velocities that wheels or a flight controller on the body would measure along a path."""

import numpy as np

from kiteline_core.arrays import F64, I64
from kiteline_core.frame import UNMEASURED, OdometryBatch
from kiteline_hw.sim.config import SimConfig
from kiteline_hw.sim.world.path import Path, flight_s

SLIP_S = 1.0  # s; mean duration of a slip
SLIP_FACTOR = 2.5  # largest factor on the true speed while a wheel slips


def measure(path: Path, t_ns: I64, start_ns: int, config: SimConfig, camera_in_body: F64) -> OdometryBatch:
    """Samples at t_ns (n,): velocity and angular rate of the body in its own axes, with noise, scale error and slips.

    Wheels measure only along the optical axis and about the camera's vertical axis. camera_in_body: T_b_c (4,4). The
    samples of a longer flight with the same seed begin with those of a shorter one.
    """
    motion = path.motion(flight_s(t_ns, start_ns))
    rng = np.random.default_rng([config.flight_seed, 53])
    draws = rng.standard_normal((len(t_ns), 6))
    velocity = np.einsum("nji,nj->ni", motion.T_w_b[:, :3, :3], motion.velocity)
    slip = _slips(len(t_ns), config.odometry, config.odometry_slip, config.flight_seed)
    velocity = config.odometry_scale * slip[:, None] * velocity + config.odometry_noise * draws[:, :3]
    rate = motion.rate + config.odometry_turn_noise * draws[:, 3:]
    velocity_cov = np.tile(_covariance(config.odometry_noise), (len(t_ns), 1, 1))
    rate_cov = np.tile(_covariance(config.odometry_turn_noise), (len(t_ns), 1, 1))
    if config.odometry_wheels:
        ahead, down = camera_in_body[:3, 2], camera_in_body[:3, 1]
        velocity, velocity_cov = _measured_along(velocity, velocity_cov, ahead)
        rate, rate_cov = _measured_along(rate, rate_cov, down)
    return OdometryBatch(t_ns, velocity, rate, velocity_cov, rate_cov)


def _covariance(sigma: float) -> F64:
    return max(sigma, 1e-3) ** 2 * np.eye(3)


def _measured_along(values: F64, cov: F64, axis: F64) -> tuple[F64, F64]:
    """Vectors (n,3) and covariances (n,3,3) if only their component along an axis is measured."""
    only = np.outer(axis, axis)
    return values @ only, only @ cov @ only + UNMEASURED * (np.eye(3) - only)


def _slips(n: int, rate_hz: float, share: float, seed: int) -> F64:
    """Factors (n,) on the speed: 1, and for a share of the time up to SLIP_FACTOR, about SLIP_S at a time."""
    out = np.ones(n)
    draws = np.random.default_rng([seed, 59]).random((n, 2))
    if share <= 0.0:
        return out
    ends = 1.0 / (SLIP_S * rate_hz)
    begins = ends * share / max(1.0 - share, 1e-6)
    factor = 1.0
    for k in range(n):
        if factor > 1.0:
            factor = 1.0 if draws[k, 0] < ends else factor
        elif draws[k, 0] < begins:
            factor = 1.3 + (SLIP_FACTOR - 1.3) * draws[k, 1]
        out[k] = factor
    return out

"""Velocity and rate at the end of a row of poses."""

import numpy as np

from kiteline_core.geometry import se3
from kiteline_core.geometry.end_rates import end_rates


def turning(t_s: float) -> np.ndarray:
    """1 m/s^2 along x, and yaw that speeds up by 0.8 rad/s^2."""
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, 0.4 * t_s**2])), np.array([0.5 * t_s**2, 0.2 * t_s, 0.0]))


def test_not_late_while_accelerating() -> None:
    t_s = np.arange(1.0, 1.21, 0.05)
    velocity, rate = end_rates([round(t * 1e9) for t in t_s], [turning(t) for t in t_s], round(1.23e9))
    np.testing.assert_allclose(velocity, [1.23, 0.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(rate, [0.0, 0.0, 0.8 * 1.23], atol=1e-6)


def test_no_noisier_than_a_difference() -> None:
    rng = np.random.default_rng(1)
    fitted, differences = [], []
    for _ in range(300):
        poses = [se3.from_rt(np.eye(3), rng.normal(0.0, 0.003, 3)) for _ in range(5)]
        fitted.append(end_rates([i * 50_000_000 for i in range(5)], poses, 200_000_000)[0])
        differences.append((poses[-1][:3, 3] - poses[-2][:3, 3]) / 0.05)
    assert np.std(fitted) < np.std(differences)


def test_two_poses_give_their_difference() -> None:
    poses = [np.eye(4), se3.from_rt(np.eye(3), np.array([0.1, 0.0, 0.0]))]
    np.testing.assert_allclose(end_rates([0, 50_000_000], poses, 50_000_000)[0], [2.0, 0.0, 0.0])

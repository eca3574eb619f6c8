"""Preintegration against exact motion, against a plain reference, and its Jacobians against differences."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_agent.inertial import imu_kernels
from kiteline_agent.inertial.preintegration import Preintegrated, Samples, preintegrate
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from tests.core.helpers_from_python import from_python

CALIBRATION = ImuCalibration()
SEEDS = st.integers(0, 2**31)


def wavy(rng: np.random.Generator, n: int, dt_s: float = 0.005) -> Samples:
    """Samples of a smooth, lively motion."""
    t = np.arange(n) * dt_s
    rates, forces = rng.uniform(1.0, 12.0, (2, 3)), rng.normal(size=(2, 3))
    gyro = 1.5 * np.sin(t[:, None] * rates[0]) + 0.5 * forces[0]
    accel = np.array([0.0, 0.0, 9.8]) + 3.0 * np.sin(t[:, None] * rates[1] + forces[1])
    return Samples(t, gyro, accel)


def reference(samples: Samples, bias: F64, density: F64) -> tuple[F64, F64, F64]:
    """Turn, changes of velocity and position, and covariance, written with whole matrices. density: (n-1,2)."""
    r, v, p, cov = np.eye(3), np.zeros(3), np.zeros(3), np.zeros((9, 9))
    for k in range(len(samples.t_s) - 1):
        dt = samples.t_s[k + 1] - samples.t_s[k]
        w = (0.5 * (samples.gyro[k] + samples.gyro[k + 1]) - bias[:3]) * dt
        a0, a1 = samples.accel[k] - bias[3:], samples.accel[k + 1] - bias[3:]
        turn = se3.so3_exp(w)
        after = r @ turn
        jr = np.column_stack([se3.so3_log(turn.T @ se3.so3_exp(w + 1e-6 * e)) / 1e-6 for e in np.eye(3)])
        by_turn = -0.5 * (r @ se3.skew(a0) + after @ se3.skew(a1) @ turn.T)
        by_gyro = 0.5 * after @ se3.skew(a1) @ jr * dt
        f, b = np.eye(9), np.zeros((9, 6))
        f[:3, :3], f[3:6, :3], f[6:, :3], f[6:, 3:6] = turn.T, by_turn * dt, 0.5 * by_turn * dt**2, dt * np.eye(3)
        b[:3, :3], b[3:6, :3], b[6:, :3] = -jr * dt, by_gyro * dt, 0.5 * by_gyro * dt**2
        b[3:6, 3:], b[6:, 3:] = -0.5 * (r + after) * dt, -0.25 * (r + after) * dt**2
        cov = f @ cov @ f.T + b @ np.diag(np.repeat(density[k] ** 2 / dt, 3)) @ b.T
        mean = 0.5 * (r @ a0 + after @ a1)
        p, v, r = p + v * dt + 0.5 * mean * dt**2, v + mean * dt, after
    return r, np.concatenate([v, p]), cov


@given(SEEDS, st.integers(2, 30))
@settings(max_examples=20)
def test_kernel_agrees_with_the_reference(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    calibrated = 2.0 * np.array([CALIBRATION.gyro_noise, CALIBRATION.accel_noise])
    measured = calibrated * rng.uniform(0.1, 5.0, (n - 1, 2))  # of each step
    samples, bias = replace(wavy(rng, n), density=measured), 0.1 * rng.normal(size=6)
    got = preintegrate(samples, bias, CALIBRATION, inflation=2.0)
    turn, vp, cov = reference(samples, bias, np.maximum(measured, calibrated))
    np.testing.assert_allclose(got.turn, turn, atol=1e-12)
    np.testing.assert_allclose(got.vp, vp, atol=1e-12)
    sigma = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(got.cov / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=1e-4)
    assert got.dt_s == pytest.approx((n - 1) * 0.005)


def test_exact_on_a_circle() -> None:
    """A body that circles at constant speed, nose ahead: position, velocity and turn are known in closed form."""
    rate, radius, dt, n = 1.3, 2.0, 0.0025, 401
    gravity = np.array([0.0, 0.0, -9.81])
    accel = np.array([0.0, rate**2 * radius, 9.81])  # x ahead, y toward the centre
    samples = Samples(np.arange(n) * dt, np.tile([0.0, 0.0, rate], (n, 1)), np.tile(accel, (n, 1)))
    T, v = preintegrate(samples, np.zeros(6), CALIBRATION).propagate(
        se3.from_rt(np.eye(3), np.array([0.0, -radius, 0.0])), np.array([rate * radius, 0.0, 0.0]), np.zeros(6), gravity
    )
    angle = rate * dt * (n - 1)
    np.testing.assert_allclose(T[:3, 3], radius * np.array([np.sin(angle), -np.cos(angle), 0.0]), atol=3e-6)
    np.testing.assert_allclose(v, rate * radius * np.array([np.cos(angle), np.sin(angle), 0.0]), atol=3e-6)
    np.testing.assert_allclose(T[:3, :3], se3.so3_exp(np.array([0.0, 0.0, angle])), atol=1e-9)


@given(SEEDS)
@settings(max_examples=15)
def test_bias_jacobian_agrees_with_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples, bias = wavy(rng, 21), 0.05 * rng.normal(size=6)
    at = preintegrate(samples, bias, CALIBRATION)
    for a in range(6):
        step = np.zeros(6)
        step[a] = 1e-5
        moved = preintegrate(samples, bias + step, CALIBRATION)
        change = np.concatenate([se3.so3_log(at.turn.T @ moved.turn), moved.vp - at.vp]) / 1e-5
        np.testing.assert_allclose(at.jac[:, a], change, atol=2e-5)


@given(SEEDS)
@settings(max_examples=15)
def test_bias_correction_is_close_to_integrating_again(seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples, change = wavy(rng, 11), rng.uniform(-0.01, 0.01, 6)
    turn, vp = preintegrate(samples, np.zeros(6), CALIBRATION).corrected(change)
    again = preintegrate(samples, change, CALIBRATION)
    assert np.linalg.norm(se3.so3_log(turn.T @ again.turn)) < 1e-7
    np.testing.assert_allclose(vp, again.vp, atol=1e-6)


def test_covariance_is_that_of_noisy_samples() -> None:
    rng = np.random.default_rng(5)
    samples = wavy(rng, 21)
    true = preintegrate(samples, np.zeros(6), CALIBRATION)
    root = np.sqrt(200.0)
    errors = []
    for _ in range(400):
        noisy = Samples(
            samples.t_s,
            samples.gyro + CALIBRATION.gyro_noise * root * rng.normal(size=(21, 3)),
            samples.accel + CALIBRATION.accel_noise * root * rng.normal(size=(21, 3)),
        )
        got = preintegrate(noisy, np.zeros(6), CALIBRATION)
        errors.append(np.concatenate([se3.so3_log(true.turn.T @ got.turn), got.vp - true.vp]))
    nees = np.mean([e @ np.linalg.solve(true.cov, e) for e in errors])
    assert 7.5 < nees < 10.0  # 9 degrees of freedom; the two end samples count half in truth


@given(st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3), st.floats(1e-9, 1.0))
@settings(max_examples=30)
def test_so3_kernels(w: list[float], size: float) -> None:
    v = np.array(w) * size
    r, j, i, back = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    imu_kernels.so3_exp(v, r)
    np.testing.assert_allclose(r, se3.so3_exp(v), atol=1e-12)
    from_python(imu_kernels.so3_log)(r, back)
    np.testing.assert_allclose(back, v, atol=1e-9)
    from_python(imu_kernels.right_jacobian)(v, j)
    from_python(imu_kernels.right_jacobian_inverse)(v, i)
    np.testing.assert_allclose(j @ i, np.eye(3), atol=1e-9)
    d = 1e-6 * np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(se3.so3_exp(v + d), se3.so3_exp(v) @ se3.so3_exp(j @ d), atol=1e-11)


@pytest.mark.parametrize("angle", [3e-5, 9e-5, 2e-4, 9.9e-4, 1.1e-3])
def test_series_of_small_angles_meet_the_closed_forms(angle: float) -> None:
    w = angle * np.array([0.6, -0.64, 0.48])
    k, r, j, i = se3.skew(w), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    imu_kernels.so3_exp(w, r)
    np.testing.assert_allclose(r, np.eye(3) + k + k @ k / 2.0 + k @ k @ k / 6.0, atol=1e-13)
    from_python(imu_kernels.right_jacobian)(w, j)
    np.testing.assert_allclose(j, np.eye(3) - k / 2.0 + k @ k / 6.0 - k @ k @ k / 24.0, atol=1e-12)
    from_python(imu_kernels.right_jacobian_inverse)(w, i)
    np.testing.assert_allclose(i, np.eye(3) + k / 2.0 + k @ k / 12.0, atol=1e-10)


def batch(t_ns: list[int], value: float = 1.0) -> ImuBatch:
    """Samples whose gyro is their time in seconds."""
    t = np.array(t_ns, np.int64)
    return ImuBatch(t, np.repeat(t[:, None] * 1e-9, 3, axis=1), np.full((len(t), 3), value))


def test_buffer_interpolates_ends_and_joins_batches() -> None:
    buffer = SampleBuffer(1.0, 0.05)
    buffer.push(batch([0, 10_000_000, 20_000_000]))
    buffer.push(None)
    buffer.push(batch([20_000_000, 30_000_000, 40_000_000]))
    samples = buffer.between(5_000_000, 33_000_000)
    np.testing.assert_allclose(samples.t_s, [0.0, 0.005, 0.015, 0.025, 0.028])
    np.testing.assert_allclose(samples.gyro[:, 0], [0.005, 0.01, 0.02, 0.03, 0.033])
    assert samples.duration_s == pytest.approx(0.028)


def test_buffer_says_no_across_a_hole_and_forgets() -> None:
    buffer = SampleBuffer(0.1, 0.02)
    buffer.push(batch([0, 10_000_000, 60_000_000, 70_000_000]))
    assert buffer.between(5_000_000, 65_000_000) is None
    assert buffer.between(62_000_000, 68_000_000) is not None
    assert buffer.between(62_000_000, 95_000_000) is None  # far beyond the newest sample
    assert buffer.between(65_000_000, 65_000_000) is None
    buffer.push(batch([300_000_000, 310_000_000]))
    assert buffer.between(62_000_000, 68_000_000) is None
    nan = batch([320_000_000])
    buffer.push(ImuBatch(nan.t_ns, nan.gyro * np.nan, nan.accel))
    assert buffer.newest_t_ns == 310_000_000


def test_prediction_composes() -> None:
    """Two intervals one after the other lead where the whole leads."""
    rng = np.random.default_rng(1)
    whole = wavy(rng, 21)
    parts = [
        Samples(whole.t_s[:11], whole.gyro[:11], whole.accel[:11]),
        Samples(whole.t_s[10:] - whole.t_s[10], whole.gyro[10:], whole.accel[10:]),
    ]
    T: F64 = se3.exp(rng.normal(size=6))
    v: F64 = rng.normal(size=3)
    gravity = np.array([0.0, 0.0, -9.81])
    motion: Preintegrated = preintegrate(whole, np.zeros(6), CALIBRATION)
    goal_T, goal_v = motion.propagate(T, v, np.zeros(6), gravity)
    for part in parts:
        T, v = preintegrate(part, np.zeros(6), CALIBRATION).propagate(T, v, np.zeros(6), gravity)
    np.testing.assert_allclose(T, goal_T, atol=1e-12)
    np.testing.assert_allclose(v, goal_v, atol=1e-12)

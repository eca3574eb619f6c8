"""Start in motion: gyro bias, velocity, gravity, scale; and the camera's time offset."""

from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_agent.inertial import initial_alignment as imu_alignment
from kiteline_agent.inertial.imu_initialisation import ImuInitialiser, TimedPose
from kiteline_agent.inertial.inertial_config import InertialConfig
from kiteline_agent.inertial.preintegration import Preintegrated, Samples, preintegrate
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

CALIBRATION = ImuCalibration()
GRAVITY = np.array([0.0, 0.0, -9.81])
P_B_C = np.array([0.15, -0.05, 0.1])
STEP_S, FRAME_STEPS = 0.005, 10


def motion(seed: int, frames: int) -> tuple[F64, F64, F64, F64]:
    """Poses and velocities at 200 Hz, gyro, accel of a body on sines."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames * FRAME_STEPS + 1) * STEP_S
    w, phase = rng.uniform(1.5, 3.0, (2, 3)), rng.uniform(0, 6.28, (2, 3))
    size = np.array([0.6, 0.6, 0.3])
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, 3] = size * np.sin(t[:, None] * w[0] + phase[0])
    velocity = size * w[0] * np.cos(t[:, None] * w[0] + phase[0])
    a = -size * w[0] ** 2 * np.sin(t[:, None] * w[0] + phase[0])
    gyro = np.empty((len(t), 3))

    def turn(x: float) -> F64:
        return se3.so3_exp(np.array([0.3, 0.3, 0.8]) * np.sin(x * w[1] + phase[1]))

    for k, x in enumerate(t):
        T[k, :3, :3] = turn(x)
        gyro[k] = se3.so3_log(turn(x - 1e-4).T @ turn(x + 1e-4)) / 2e-4
    return T, velocity, gyro, np.einsum("nji,nj->ni", T[:, :3, :3], a - GRAVITY)


def measured(seed: int, frames: int, bias: F64) -> tuple[F64, F64, list[Preintegrated]]:
    """Poses and velocities at the frames, and what the IMU with a bias makes of the time between."""
    T, velocity, gyro, accel = motion(seed, frames)
    t = np.arange(FRAME_STEPS + 1) * STEP_S
    parts = [slice(k * FRAME_STEPS, (k + 1) * FRAME_STEPS + 1) for k in range(frames)]
    motions = [
        preintegrate(Samples(t, gyro[s] + bias[:3], accel[s] + bias[3:]), np.zeros(6), CALIBRATION) for s in parts
    ]
    return T[::FRAME_STEPS], velocity[::FRAME_STEPS], motions


@given(st.integers(0, 2**31))
@settings(max_examples=12)
def test_gyro_bias(seed: int) -> None:
    bias = np.concatenate([np.random.default_rng(seed).uniform(-0.1, 0.1, 3), np.zeros(3)])
    poses, _, motions = measured(seed, 12, bias)
    np.testing.assert_allclose(imu_alignment.gyro_bias(poses, motions), bias[:3], atol=1e-4)


@given(st.integers(0, 2**31), st.floats(-0.5, 0.5))
@settings(max_examples=12)
def test_velocity_and_gravity_in_a_map_of_any_tilt(seed: int, tilt: float) -> None:
    poses, velocities, motions = measured(seed, 16, np.zeros(6))
    turn = se3.so3_exp(np.array([tilt, -tilt, 0.3]))
    found = imu_alignment.align(
        se3.from_rt(turn, np.array([1.0, 2.0, 3.0])) @ poses, P_B_C, motions, np.zeros(6), 9.81, with_scale=False
    )
    np.testing.assert_allclose(found.gravity, turn @ GRAVITY, atol=0.03)
    np.testing.assert_allclose(found.velocities, velocities @ turn.T, atol=0.01)
    assert found.residual_m < 1e-3 and found.gravity_error < 0.01


@pytest.mark.parametrize("seed", range(8))
def test_scale_of_a_map_without_one(seed: int) -> None:
    """Camera positions in a foreign unit, with noise, from an IMU with a bias."""
    rng = np.random.default_rng([seed, 3])
    scale, bias = float(np.exp(rng.uniform(-2.0, 2.0))), np.concatenate([np.zeros(3), rng.uniform(-0.06, 0.06, 3)])
    poses, velocities, motions = measured(seed, 40, bias)
    mono = poses.copy()
    offset = poses[:, :3, :3] @ P_B_C
    mono[:, :3, 3] = (poses[:, :3, 3] + offset + 0.002 * rng.normal(size=(41, 3))) / scale - offset
    found = imu_alignment.align(mono, P_B_C, motions, np.zeros(6), 9.81, with_scale=True)
    assert found.scale == pytest.approx(scale, rel=0.03)
    assert abs(found.scale - scale) < 5.0 * found.scale_sigma
    np.testing.assert_allclose(found.velocities[-1], velocities[-1], atol=0.08)


def test_scale_is_not_believed_without_acceleration() -> None:
    """At constant velocity any scale fits: its deviation must say so, or there is no answer."""
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 0, 3] = 0.05 * np.arange(30)
    t = np.arange(FRAME_STEPS + 1) * STEP_S
    still = Samples(t, np.zeros((FRAME_STEPS + 1, 3)), np.tile(-GRAVITY, (FRAME_STEPS + 1, 1)))
    motions = [preintegrate(still, np.zeros(6), CALIBRATION)] * 29
    found = imu_alignment.align(poses, np.zeros(3), motions, np.zeros(6), 9.81, with_scale=True)
    assert found is None or found.scale_sigma > 0.5 * found.scale


def test_too_few_poses_give_nothing() -> None:
    poses, _, motions = measured(1, 3, np.zeros(6))
    assert imu_alignment.align(poses, P_B_C, motions, np.zeros(6), 9.81, with_scale=False) is None


@pytest.mark.parametrize(("rate_hz", "kept"), [(20, 60), (10, 30), (2, 7)])
def test_the_window_is_as_long_at_any_frame_rate_but_never_too_thin(rate_hz: int, kept: int) -> None:
    window = ImuInitialiser(
        InertialConfig(), CALIBRATION, np.zeros(3), cast(SampleBuffer, None), lambda samples: samples
    )
    for k in range(100):
        window.add(TimedPose(k * 1_000_000_000 // rate_hz, np.eye(4), cast(Samples, object()) if k else None))
    assert len(window._poses) == kept

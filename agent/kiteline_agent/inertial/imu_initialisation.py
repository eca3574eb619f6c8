"""Initialisation of the inertial state from a window of poses by images: at rest, or in motion."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from kiteline_agent.inertial import initial_alignment
from kiteline_agent.inertial.fixed_lag import FixedLagSmoother
from kiteline_agent.inertial.inertial_config import InertialConfig, StartDeviations
from kiteline_agent.inertial.preintegration import Preintegrated, Samples, TimeOffset, preintegrate
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration

_MIN_FRAMES = 5
_REST_SAMPLES = 20
_REST_WINDOW_S = 0.3  # s that the vehicle must stand still to start from rest
_REST_MOVED_M = 0.005  # m; most motion by the images during that rest
_LEVEL_WINDOW_S = 0.19  # s after which gravity is known to a degree: five frames at 20 Hz
_LEVEL_ERROR = 0.03  # relative error of gravity's length then: its direction is as accurate
_MOTION_WINDOW_S = 0.7  # s; window of the initialisation in motion
_WINDOW_S = 2.97  # s of poses kept before the initialisation, for gravity at rest and in slow flight
_MAX_RESIDUAL_M = 0.02  # m; of the initialisation: above it the poses do not fit the IMU
_MAX_GRAVITY_ERROR = 0.12  # relative; of gravity's length that is found without imposing it


@dataclass(frozen=True, slots=True)
class TimedPose:
    """T_m_b (4,4) at t_ns, and the IMU samples since the pose before (None for the first one).

    awaited: begin and end, IMU time, of the samples if the last of them had not come: an IMU whose stamps are late.
    """

    t_ns: int
    T_m_b: F64
    samples: Samples | None
    awaited: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class InertialStartState:
    """A known state at a frame, in any frame w.

    T_w_b: (4,4). velocity: (3,) m/s. bias: (6,). gravity: (3,) m/s^2. cov: (17,17) as in InertialState, of full rank;
    None: that of StartDeviations.
    accel_noise: factor on the accelerometer's noise. offset: of time; None: not found.
    """

    T_w_b: F64
    velocity: F64
    bias: F64
    gravity: F64
    cov: F64 | None
    accel_noise: float = 1.0
    offset: TimeOffset | None = None


class ImuInitialiser:
    """Window of poses by images, from which gravity, velocity, biases and scale are estimated."""

    def __init__(
        self, config: InertialConfig, calibration: ImuCalibration, p_b_c: F64, buffer: SampleBuffer,
        correct: Callable[[Samples], Samples],
    ) -> None:  # fmt: skip
        """p_b_c: (3,) m, camera in the body. correct: samples as the flight has calibrated them."""
        self._config = config
        self._calibration = calibration
        self._p_b_c = p_b_c
        self._buffer = buffer
        self._correct = correct
        self._poses: list[TimedPose] = []

    def clear(self) -> None:
        """Empty the window."""
        self._poses = []

    def add(self, pose: TimedPose) -> None:
        """Append a pose; one without samples begins a new window."""
        if pose.samples is None:
            self._poses = []
        self._poses.append(pose)
        self._poses = [self._completed(p) for p in self._poses]
        recent = sum((pose.t_ns - p.t_ns) * 1e-9 <= _WINDOW_S for p in self._poses)
        del self._poses[: -max(recent, self._config.motion_frames)]

    def _completed(self, pose: TimedPose) -> TimedPose:
        if pose.awaited is None or self._buffer.lacks(pose.awaited[1]):
            return pose
        samples = self._buffer.between(*pose.awaited)
        return pose if samples is None else replace(pose, samples=self._correct(samples), awaited=None)

    def transform(self, function: Callable[[F64], F64]) -> None:
        """Replace every pose T_m_b by function(T_m_b)."""
        self._poses = [replace(p, T_m_b=function(p.T_m_b)) for p in self._poses]

    def _velocity(self) -> F64:
        """Velocity (3,) m/s between the last two poses; zero with fewer."""
        if len(self._poses) < 2:
            return np.zeros(3)
        a, b = self._poses[-2], self._poses[-1]
        return np.asarray((b.T_m_b[:3, 3] - a.T_m_b[:3, 3]) / ((b.t_ns - a.t_ns) * 1e-9))

    def gravity(self, bias: F64) -> F64 | None:
        """Gravity (3,) m/s^2 in m, a few frames after the start; None before. bias: (6,)."""
        config = self._config
        if len(self._poses) < _MIN_FRAMES or self._span_s() < _LEVEL_WINDOW_S:
            return None
        poses, motions = self._window(len(self._poses), bias)
        if len(motions) < len(poses) - 1:
            return None
        found = initial_alignment.align(poses, self._p_b_c, motions, bias, config.gravity_m_s2, with_scale=False)
        fits = found is not None and found.residual_m < _MAX_RESIDUAL_M
        return found.gravity if found is not None and fits and found.gravity_error < _LEVEL_ERROR else None

    def start(self, smoother: FixedLagSmoother, bias: F64) -> Literal["rest", "motion"] | None:
        """Start the smoother at the last pose if the window allows it; returns how. bias: (6,) last known."""
        if len(self._poses) < _MIN_FRAMES:
            return None
        span_s = self._span_s()
        if span_s >= _REST_WINDOW_S and self._start_at_rest(smoother, bias):
            self.clear()
            return "rest"
        if span_s >= _MOTION_WINDOW_S and self._start_in_motion(smoother, bias):
            self.clear()
            return "motion"
        return None

    def _start_at_rest(self, smoother: FixedLagSmoother, bias: F64) -> bool:
        config, last = self._config, self._poses[-1]
        recent = [p for p in self._poses if (last.t_ns - p.t_ns) * 1e-9 <= _REST_WINDOW_S + 0.1]
        moved = max(float(np.linalg.norm(p.T_m_b[:3, 3] - last.T_m_b[:3, 3])) for p in recent)
        samples = self._buffer.within(recent[0].t_ns, last.t_ns)
        if len(samples) < _REST_SAMPLES or moved > _REST_MOVED_M:
            return False
        mean, spread = samples.mean(axis=0), samples.std(axis=0)
        if spread[:3].max() >= config.rest_gyro_rad_s or spread[3:].max() >= config.rest_accel_m_s2:
            return False
        if abs(np.linalg.norm(mean[3:]) - config.gravity_m_s2) > 0.1 * config.gravity_m_s2:
            return False
        still = self._correct(Samples(np.array([0.0, 1.0]), np.tile(mean[:3], (2, 1)), np.tile(mean[3:], (2, 1))))
        bias = np.concatenate([still.gyro[0], bias[3:]])
        gravity = -last.T_m_b[:3, :3] @ (still.accel[0] - bias[3:])
        deviations = StartDeviations(velocity_m_s=0.02, gyro_bias_rad_s=0.002)
        smoother.start(last.T_m_b, np.zeros(3), bias, gravity, deviations)
        return True

    def _start_in_motion(self, smoother: FixedLagSmoother, bias: F64) -> bool:
        config, last = self._config, self._poses[-1]
        recent = sum((last.t_ns - p.t_ns) * 1e-9 <= _MOTION_WINDOW_S + 0.3 for p in self._poses)
        poses, motions = self._window(max(recent, config.motion_frames), bias)
        bias = np.concatenate([initial_alignment.gyro_bias(poses, motions), bias[3:]])
        found = initial_alignment.align(poses, self._p_b_c, motions, bias, config.gravity_m_s2, with_scale=False)
        if found is None or found.residual_m > _MAX_RESIDUAL_M or found.gravity_error > _MAX_GRAVITY_ERROR:
            return False
        bias[3:] = found.accel_bias
        velocity = found.velocities[-1] if last.awaited is None else self._velocity()
        smoother.start(last.T_m_b, velocity, bias, found.gravity, StartDeviations())
        return True

    def _span_s(self) -> float:
        return (self._poses[-1].t_ns - self._poses[0].t_ns) * 1e-9

    def _window(self, most: int, bias: F64) -> tuple[F64, list[Preintegrated]]:
        """The newest poses (n,4,4) whose samples have come, and the motions between them."""
        poses = [pose for pose in self._poses[-most:] if pose.awaited is None]
        motions = [preintegrate(p.samples, bias, self._calibration) for p in poses[1:] if p.samples is not None]
        return np.array([p.T_m_b for p in poses]), motions

"""The inertial half of tracking: start at rest or in motion, predict, fuse with what the images saw, coast when
blind.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.inertial import initial_alignment as imu_alignment
from kiteline_agent.inertial.fixed_lag import (
    BodyVelocity,
    FixedLagConfig,
    FixedLagSmoother,
    InertialState,
    StartDeviations,
    VisualPoints,
    tilt_of,
)
from kiteline_agent.inertial.preintegration import Preintegrated, SampleBuffer, Samples, preintegrate
from kiteline_agent.inertial.time_offset import TimeOffsetEstimator
from kiteline_agent.inertial.turn_watch import TurnWatch
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera

F64 = NDArray[np.float64]

_SCALE_FRAMES = 20  # fewer cannot tell acceleration from scale


@dataclass(frozen=True, slots=True)
class InertialConfig:
    """How the inertial part starts, and when it gives up."""

    smoother: FixedLagConfig = field(default_factory=FixedLagConfig)
    gravity_m_s2: float = 9.81  # differs by 0.3 % over the earth, which the accelerometer's bias takes up
    silent_s: float = 3.0  # without any sample, after which people are told
    max_gap_s: float = 0.05  # a longer hole in the samples makes an interval unknown
    rest_window_s: float = 0.3  # so long must the vehicle stand to start from rest
    rest_gyro_rad_s: float = 0.02  # deviation of the gyro below which it stands
    rest_accel_m_s2: float = 0.15  # the same of the accelerometer: motors may idle
    rest_moved_m: float = 0.005  # most that the images may have moved meanwhile
    level_window_s: float = 0.19  # after which gravity is known to a degree: five frames at 20 Hz
    level_error: float = 0.03  # relative, of gravity's length as found then: its direction is as good
    level_patience_s: float = 2.0  # so long a flight controller waits at most for level poses
    motion_window_s: float = 0.7  # window of the alignment in motion
    motion_frames: int = 7  # of that window at least, where frames are few: with five, noise would do for accelerations
    window_frames: int = 60  # most frames that are kept while waiting; a scale needs some seconds
    max_residual_m: float = 0.02  # of the alignment: above it the poses do not fit the IMU, wait on
    max_gravity_error: float = 0.12  # relative, of its length as found without knowing it
    trusted_blind_s: float = 1.0  # so long the IMU alone counts as tracking
    askew_rad: float = 0.035  # a map that leans by more than two degrees is set upright
    max_coast_s: float = 20.0  # longer without images, a small IMU knows no more than that velocities change
    scale_inflation: float = 2.0  # of the deviation of a scale: a young map errs alike from frame to frame
    unit_sigma: float = 0.03  # relative, of what IMU and odometer each do not know of their own scale
    offset_memory_s: float = 60.0  # a time offset drifts slowly
    offset_start_sigma_s: float = 0.02  # cameras without a trigger line
    offset_window_s: float = 0.15  # over which turns are compared
    offset_turn_sigma_rad: float = 6e-4  # error of a visual turn meanwhile
    offset_trusted_s: float = 3e-3  # deviation below which the estimate is applied
    offset_significance: float = 3.0  # deviations from the applied offset below which it stays: most rigs have none
    offset_rate: float = 0.05  # s/s, how fast the applied offset follows
    offset_s: float = 0.0  # camera stamp + offset = time of the IMU, where a calibration says so
    apply_offset: bool = True  # False: only what is configured


@dataclass(frozen=True, slots=True)
class Prediction:
    """T_m_b: (4,4) where the body should be. velocity: (3,) m/s in m. turn_R_b0_b1: (3,3) since the last frame."""

    T_m_b: F64
    velocity: F64
    turn_R_b0_b1: F64


@dataclass(frozen=True, slots=True)
class _Pose:
    t_ns: int
    T_m_b: F64
    samples: Samples | None  # that lead here from the pose before


class InertialTracker:
    """Once a frame: `predict`, then `update` with what the images saw or `coast` without. Pure; no clocks."""

    def __init__(
        self, camera: RectifiedCamera, calibration: ImuCalibration, config: InertialConfig, *, metric: bool = True
    ) -> None:
        self._config = config
        self._calibration = calibration
        self._p_b_c = camera.T_b_c[:3, 3].copy()
        self._buffer = SampleBuffer(3.0, config.max_gap_s)
        self._smoother = FixedLagSmoother(camera, calibration, config.smoother, config.gravity_m_s2)
        self._offset = TimeOffsetEstimator(
            config.offset_memory_s, config.offset_start_sigma_s, config.offset_turn_sigma_rad, config.offset_s
        )
        self._watch = TurnWatch(calibration, config.offset_window_s)
        self._applied_s = self._told_s = config.offset_s
        self._held: tuple[int, int] | None = None  # the last interval, where samples of its end had not come yet
        self._bias = np.zeros(6)
        self._waiting: list[_Pose] = []
        self._last: _Pose | None = None  # the last pose, however it was come by
        self._last_visual: tuple[int, F64] | None = None
        self._ends_ns = 0  # instant of the IMU at which the last interval ended
        self._blind_s = 0.0
        self.started: str | None = None  # "rest" or "motion", how the smoother started last
        self.metric = metric  # False: the map's unit is unknown, nothing but `metric_scale` is sought

    # what is known

    @property
    def running(self) -> bool:
        """Whether velocity, gravity and biases are known, so that `coast` can carry the pose."""
        return self._smoother.running

    @property
    def state(self) -> InertialState | None:
        """The newest state; None while waiting for a start."""
        return self._smoother.state if self._smoother.running else None

    def level_R(self) -> F64 | None:
        """R_level_m (3,3): the turn that sets the map upright; None until gravity is known, a few frames after the
        begin.
        """
        if self._smoother.running:
            tilt = self._smoother.state.tilt
        else:
            gravity = self._gravity_so_far()
            if gravity is None:
                return None
            tilt = tilt_of(gravity)
        return se3.so3_exp(np.array([-tilt[0], -tilt[1], 0.0]))

    @property
    def time_offset_s(self) -> tuple[float, float]:
        """Camera stamp + offset = time of the IMU, and one standard deviation, s."""
        return self._offset.offset_s, self._offset.sigma_s

    def offset_report(self) -> dict[str, float]:
        """The time offset in ms: as estimated, one standard deviation of that, and what is applied."""
        offset_s, sigma_s = self.time_offset_s
        told = {"ms": offset_s, "sigma_ms": sigma_s, "applied_ms": self._applied_s}
        return {name: round(1e3 * value, 2) for name, value in told.items()}

    def offset_news(self) -> list[str]:
        """What to tell of the applied offset: a line whenever it has moved by a millisecond."""
        if abs(self._applied_s - self._told_s) < 1e-3:
            return []
        self._told_s = self._applied_s
        offset_s, sigma_s = self.time_offset_s
        return [f"camera stamps + {1e3 * offset_s:.1f} ms are the IMU's time (deviation {1e3 * sigma_s:.1f} ms)"]

    @property
    def blind_s(self) -> float:
        """How long the IMU alone has carried the pose."""
        return self._blind_s

    # once a frame

    def predict(self, imu: ImuBatch | None, t_ns: int) -> Prediction | None:
        """Take in samples, and say where the body should be at t_ns. None where samples are missing or nothing is
        known.
        """
        self._buffer.push(imu)
        if self._last is None:
            return None
        samples = self._interval(t_ns)
        if samples is None:
            return None
        if self._smoother.running:
            T_m_b, velocity = self._smoother.predict(samples)
            return Prediction(T_m_b, velocity, self._last.T_m_b[:3, :3].T @ T_m_b[:3, :3])
        motion = preintegrate(samples, self._bias, self._calibration)
        velocity = self._visual_velocity()
        T = self._last.T_m_b.copy()
        T[:3, 3] += velocity * (t_ns - self._last.t_ns) * 1e-9
        T[:3, :3] = T[:3, :3] @ motion.turn
        return Prediction(T, velocity, motion.turn)

    def update(
        self, t_ns: int, T_m_b_visual: F64, points: VisualPoints, driven: BodyVelocity | None = None
    ) -> InertialState | None:
        """A frame was measured: T_m_b_visual (4,4) by images alone, from `points`. driven: by an odometer. The state
        that all together give, or None while waiting for a start or where samples are missing (then the images alone
        hold).
        """
        samples = self._interval(t_ns)
        if samples is not None:
            self._watch.see(t_ns, T_m_b_visual[:3, :3])
            self._follow_offset(samples.duration_s)
        state = None
        if self._smoother.running:
            state = self._advance(samples, points, driven)
        if state is None:
            self._wait(_Pose(t_ns, T_m_b_visual.copy(), samples))
            self._note(t_ns, T_m_b_visual)
            self._try_start()
        else:
            self._note(t_ns, state.T_m_b)
        self._last_visual = (t_ns, T_m_b_visual.copy())
        self._blind_s = 0.0
        return state

    def coast(self, t_ns: int, driven: BodyVelocity | None = None) -> InertialState | None:
        """A frame without images: the IMU (and an odometer) carries the state, its covariance grows. None when it
        cannot.
        """
        samples = self._interval(t_ns)
        self._last_visual = None
        self._watch.forget()
        self._waiting = []
        if self._last is not None:
            self._blind_s += (t_ns - self._last.t_ns) * 1e-9
        state = None
        if self._smoother.running and self._blind_s <= self._config.max_coast_s:
            state = self._advance(samples, None, driven)
        if state is None:
            self._smoother.stop()
            return None
        self._note(t_ns, state.T_m_b)
        return state

    def shift_map(self, T_new_old: F64) -> None:
        """The map moved under the vehicle between two frames: p_new = T_new_old p_old."""
        self._smoother.shift_map(T_new_old)
        self._waiting = [_Pose(p.t_ns, T_new_old @ p.T_m_b, p.samples) for p in self._waiting]
        if self._last is not None:
            self._last = _Pose(self._last.t_ns, T_new_old @ self._last.T_m_b, self._last.samples)
        if self._last_visual is not None:
            self._last_visual = (self._last_visual[0], T_new_old @ self._last_visual[1])
        self._watch.turn_map(T_new_old[:3, :3])

    def begin_map(self, t_ns: int, T_m_b: F64) -> None:
        """A new map begins at this frame, where the body is at T_m_b (4,4) by definition. What is known of velocity,
        gravity and biases goes along when the smoother runs (tracking or coasting up to now); else it waits for a
        start.
        """
        if self._smoother.running:
            self._smoother.begin_map(T_m_b)
        self._watch.forget()
        self._held = None
        self._waiting = []
        self._note(t_ns, T_m_b)
        self._last_visual = (t_ns, T_m_b.copy())
        self._blind_s = 0.0
        if not self._smoother.running:
            self._wait(_Pose(t_ns, T_m_b.copy(), None))

    def reset(self) -> None:
        """A new map begins whose place is not known relative to the old one. Biases are kept."""
        self._smoother.stop()
        self._waiting = []
        self._last = self._last_visual = None
        self._watch.forget()
        self._held = None
        self._blind_s = 0.0

    def metric_scale(self) -> tuple[float, float] | None:
        """Metres per unit of a map without scale, and one deviation, from the frames seen while waiting; None if
        unknown.
        """
        poses, motions = self._window(self._config.window_frames)
        if len(poses) < _SCALE_FRAMES or len(motions) < len(poses) - 1:
            return None
        bias = np.concatenate([imu_alignment.gyro_bias(poses, motions), self._bias[3:]])
        found = imu_alignment.align(poses, self._p_b_c, motions, bias, self._config.gravity_m_s2, with_scale=True)
        return None if found is None else (found.scale, self._config.scale_inflation * found.scale_sigma)

    def rescale(self, scale: float) -> None:
        """The map was multiplied by `scale` and is metric from now on: the smoother may start."""

        def scaled(p: _Pose) -> _Pose:
            T = p.T_m_b.copy()
            offset = T[:3, :3] @ self._p_b_c
            T[:3, 3] = scale * (T[:3, 3] + offset) - offset
            return _Pose(p.t_ns, T, p.samples)

        self.metric = True
        self._waiting = [scaled(p) for p in self._waiting]
        self._last = None if self._last is None else scaled(self._last)

    # parts

    def _interval(self, t_ns: int) -> Samples | None:
        """Samples from the last frame to this one, on the IMU's clock."""
        if self._last is None:
            return None
        begin = self._ends_ns if self._ends_ns else self._last.t_ns + int(self._applied_s * 1e9)
        return self._buffer.between(begin, t_ns + int(self._applied_s * 1e9))

    def _note(self, t_ns: int, T_m_b: F64) -> None:
        self._last = _Pose(t_ns, T_m_b.copy(), None)
        self._ends_ns = t_ns + int(self._applied_s * 1e9)

    def _advance(
        self, samples: Samples | None, points: VisualPoints | None, driven: BodyVelocity | None
    ) -> InertialState | None:
        if samples is None:
            self._smoother.stop()
            return None
        self._complete()
        state = self._smoother.add(samples, points, driven)
        if state is not None:
            self._bias = state.bias
        end_ns = self._ends_ns + round(samples.duration_s * 1e9)
        newest = self._buffer.newest_t_ns
        self._held = (self._ends_ns, end_ns) if newest is not None and newest < end_ns else None
        return state

    def _complete(self) -> None:
        """Where stamps of the IMU run ahead of the camera's, the end of an interval comes after its frame."""
        if self._held is not None:
            samples = self._buffer.between(*self._held)
            if samples is not None:
                self._smoother.replace_last(samples)

    def _follow_offset(self, dt_s: float) -> None:
        config = self._config
        self._watch.look(self._buffer, self._applied_s, self._offset)
        if not config.apply_offset:
            return
        offset_s, sigma_s = self.time_offset_s
        significant = abs(offset_s - self._applied_s) > config.offset_significance * sigma_s
        if sigma_s < config.offset_trusted_s and significant:
            step = offset_s - self._applied_s
            self._applied_s += float(np.clip(step, -config.offset_rate * dt_s, config.offset_rate * dt_s))

    def _gravity_so_far(self) -> F64 | None:
        """Gravity (3,) in m from the frames that wait for a start, well before they are enough for one."""
        config = self._config
        if not self.metric or len(self._waiting) < 5:
            return None
        if (self._waiting[-1].t_ns - self._waiting[0].t_ns) * 1e-9 < config.level_window_s:
            return None
        poses, motions = self._window(config.window_frames)
        if len(motions) < len(poses) - 1:
            return None
        found = imu_alignment.align(poses, self._p_b_c, motions, self._bias, config.gravity_m_s2, with_scale=False)
        fits = found is not None and found.residual_m < config.max_residual_m
        return found.gravity if found is not None and fits and found.gravity_error < config.level_error else None

    # start

    def _wait(self, pose: _Pose) -> None:
        if pose.samples is None:
            self._waiting = []
        self._waiting = [*self._waiting, pose][-self._config.window_frames :]

    def _visual_velocity(self) -> F64:
        if len(self._waiting) < 2:
            return np.zeros(3)
        a, b = self._waiting[-2], self._waiting[-1]
        return np.asarray((b.T_m_b[:3, 3] - a.T_m_b[:3, 3]) / ((b.t_ns - a.t_ns) * 1e-9))

    def _window(self, most: int) -> tuple[F64, list[Preintegrated]]:
        poses = self._waiting[-most:]
        motions = [preintegrate(p.samples, self._bias, self._calibration) for p in poses[1:] if p.samples is not None]
        return np.array([p.T_m_b for p in poses]), motions

    def _try_start(self) -> None:
        if len(self._waiting) < 5 or not self.metric:
            return
        last = self._waiting[-1]
        span_s = (last.t_ns - self._waiting[0].t_ns) * 1e-9
        if span_s >= self._config.rest_window_s and self._start_at_rest(last):
            self.started = "rest"
        elif span_s >= self._config.motion_window_s and self._start_in_motion(last):
            self.started = "motion"
        else:
            return
        self._waiting = []

    def _start_at_rest(self, last: _Pose) -> bool:
        config = self._config
        recent = [p for p in self._waiting if (last.t_ns - p.t_ns) * 1e-9 <= config.rest_window_s + 0.1]
        moved = max(float(np.linalg.norm(p.T_m_b[:3, 3] - last.T_m_b[:3, 3])) for p in recent)
        mean, spread, n = self._buffer.mean(recent[0].t_ns, last.t_ns)
        quiet = spread[:3].max() < config.rest_gyro_rad_s and spread[3:].max() < config.rest_accel_m_s2
        if n < 20 or not quiet or moved > config.rest_moved_m:
            return False
        if abs(np.linalg.norm(mean[3:]) - config.gravity_m_s2) > 0.1 * config.gravity_m_s2:
            return False
        bias = np.concatenate([mean[:3], self._bias[3:]])
        gravity = -last.T_m_b[:3, :3] @ (mean[3:] - bias[3:])
        deviations = StartDeviations(velocity_m_s=0.02, gyro_bias_rad_s=0.002)
        self._smoother.start(last.T_m_b, np.zeros(3), bias, gravity, deviations)
        return True

    def _start_in_motion(self, last: _Pose) -> bool:
        config = self._config
        recent = sum((last.t_ns - p.t_ns) * 1e-9 <= config.motion_window_s + 0.3 for p in self._waiting)
        poses, motions = self._window(max(recent, config.motion_frames))
        gyro = imu_alignment.gyro_bias(poses, motions)
        bias = np.concatenate([gyro, self._bias[3:]])
        found = imu_alignment.align(poses, self._p_b_c, motions, bias, config.gravity_m_s2, with_scale=False)
        if found is None or found.residual_m > config.max_residual_m or found.gravity_error > config.max_gravity_error:
            return False
        bias[3:] = found.accel_bias
        self._smoother.start(last.T_m_b, found.velocities[-1], bias, found.gravity, StartDeviations())
        return True

"""Inertial tracking: initialisation, prediction, fusion with poses from images, and dead reckoning without them."""

import numpy as np

from kiteline_agent.inertial.bias_relaxation import BiasRelaxation
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_agent.inertial.calibration.self_calibration import SelfCalibration
from kiteline_agent.inertial.clocks.frame_clock import FrameClock
from kiteline_agent.inertial.fixed_lag import (
    MOST_STATES,
    BodyVelocity,
    FixedLagSmoother,
    InertialMotion,
    InertialState,
    VisualPoints,
    tilt_of,
)
from kiteline_agent.inertial.imu_initialisation import ImuInitialiser, InertialStartState, TimedPose
from kiteline_agent.inertial.imu_prior import ImuPrior
from kiteline_agent.inertial.inertial_config import InertialConfig, StartDeviations
from kiteline_agent.inertial.preintegration import BiasPrior, Preintegrated, Samples, preintegrate
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer, without_held
from kiteline_agent.inertial.scale_filter import ScaleFilter, camera_scaled
from kiteline_agent.inertial.scale_watch import ScaleWatch
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import disparity_offset, se3
from kiteline_core.geometry.cameras import RectifiedCamera

_PRIOR_SIGMA = np.repeat([0.005, 0.1], 3)  # rad/s, m/s^2: of biases of earlier tracking, after a loss


class InertialTracker:
    """Call `predict` once a frame, then `update` with the pose from images or `dead_reckon` without one."""

    def __init__(
        self, camera: RectifiedCamera, calibration: ImuCalibration, config: InertialConfig, *, metric: bool = True
    ) -> None:
        self._config = config
        self._calibration = calibration
        self._p_b_c, self._bf = camera.T_b_c[:3, 3].copy(), camera.bf
        self._buffer = SampleBuffer(3.0, config.max_gap_s)
        self.clock = FrameClock()
        self._smoother = FixedLagSmoother(camera, calibration, config.smoother, config.gravity_m_s2)
        self.self_calibration = SelfCalibration(
            calibration, config.calibration, self._p_b_c, config.gravity_m_s2, metric=metric
        )
        self._initialiser = ImuInitialiser(
            config, calibration, self._p_b_c, self._buffer, self.self_calibration.correct
        )
        self._reported_s = self._followed_s = config.calibration.offset_s  # time offset last told; applied then
        self._relaxation = BiasRelaxation()
        self.scale = ScaleFilter(calibration, config.gravity_m_s2, self._p_b_c)  # of a monocular map
        self._scale_watch = ScaleWatch(self.scale, self._p_b_c, self._has_come, self._between_frames)
        # the interval that was asked for last
        self._cached: tuple[tuple[int, int, int | None], Samples | None] | None = None
        self._incomplete: list[tuple[int, int]] = []  # the last intervals, if samples at their ends were missing
        self._bias = np.zeros(6)
        self._last: tuple[int, F64] | None = None  # stamp and T_m_b of the last frame
        self._interval_end_ns = 0  # IMU time
        self._image_loss_s = 0.0
        self.started: str | None = None  # "rest" or "motion": how the smoother was last started
        self._images_have_scale = metric
        self.metric = metric  # False: the map's scale is unknown, and the IMU is only compared with rotations

    # state

    @property
    def running(self) -> bool:
        """True if velocity, gravity and biases are known, so that dead reckoning is possible."""
        return self._smoother.running

    @property
    def state(self) -> InertialState | None:
        """The newest state; None before the initialisation."""
        return self._smoother.state if self._smoother.running else None

    @property
    def known(self) -> ImuPrior:
        """What a new map begins with: values that are applied, biases so far, and how far these may have moved."""
        bias = BiasPrior(self._bias.copy(), _PRIOR_SIGMA) if self.started is not None else None
        return ImuPrior(bias, self.self_calibration.applied_offset, self.self_calibration.correct, self.clock)

    @property
    def image_loss_s(self) -> float:
        """Time since the last frame with a pose from images."""
        return self._image_loss_s

    def gravity_rotation(self) -> F64 | None:
        """R_l_m (3,3) that gravity-aligns the map, by smoother or initialiser; None until it is known."""
        if self._smoother.running:
            tilt = self._smoother.state.tilt
        else:
            gravity = self._initialiser.gravity(self._bias) if self.metric else None
            if gravity is None:
                return None
            tilt = tilt_of(gravity)
        return se3.so3_exp(np.array([-tilt[0], -tilt[1], 0.0]))

    @property
    def time_offset_s(self) -> tuple[float, float]:
        """Camera stamp + offset = IMU time, and its standard deviation, s."""
        return self.self_calibration.gyro.offset_s, self.self_calibration.gyro.offset_sigma_s

    def offset_report(self) -> dict[str, float]:
        """In ms: time offset, its deviation, what is applied, and the scatter of stamps that is corrected."""
        (offset_s, sigma_s), applied_s = self.time_offset_s, self.self_calibration.offset_s
        values = {"ms": offset_s, "sigma_ms": sigma_s, "applied_ms": applied_s, "jitter_ms": self.clock.jitter_s}
        return {name: round(1e3 * value, 2) for name, value in values.items()}

    def take_calibration_events(self) -> list[str]:
        """Lines for the log: the applied offset follows one that was not told yet, a correction of axes began."""
        events = self.self_calibration.take_events() + self.clock.take_events()
        applied_s, (found_s, sigma_s) = self.self_calibration.offset_s, self.time_offset_s
        if abs(applied_s - self._followed_s) >= 1e-3:  # it follows in steps, each of which is no news
            self._followed_s = applied_s
            if abs(found_s - self._reported_s) >= 1e-3:
                self._reported_s = found_s
                found_ms, sigma_ms = 1e3 * found_s, 1e3 * sigma_s
                events.append(f"camera stamps + {found_ms:.1f} ms are the IMU's time (deviation {sigma_ms:.1f} ms)")
        return events

    def begin_with(self, known: KnownImuConfig) -> None:
        """Begin with what earlier flights found of the IMU."""
        self.self_calibration.begin_with(known)
        self._reported_s = self._followed_s = self.self_calibration.offset_s

    # per frame

    def predict(self, imu: ImuBatch | None, t_ns: int) -> F64 | None:
        """Buffer samples and predict T_m_b (4,4) at t_ns; None without samples, or while the velocity is unknown."""
        self._buffer.push(imu)
        samples = self._interval(self.clock.taken_ns(t_ns))
        if samples is None or self.self_calibration.awaits_search or not self._smoother.running:
            return None
        return self._smoother.predict(samples)

    def turn(self, t_ns: int) -> F64 | None:
        """Rotation (3,3) R_b0_b1 of the body from the last frame to t_ns, by the gyro; None without samples."""
        samples = self._interval(self.clock.taken_ns(t_ns))
        if samples is None or self.self_calibration.awaits_search:
            return None
        return preintegrate(samples, self._bias, self._calibration).turn

    def extrapolate(self, imu: ImuBatch | None, t_ns: int) -> InertialMotion | None:
        """The body at t_ns, after the last frame, by the samples so far and `imu`. The state stays as it is.

        None without samples, or while the velocity is unknown.
        """
        if self._last is None or not self._smoother.running:
            return None
        # a frame may have been taken later than it is stamped
        end_ns = max(self.clock.taken_ns(t_ns) + self._offset_ns, self._interval_end_ns + 1)
        samples = self._buffer.extended(imu).ahead(self._interval_end_ns, end_ns)
        if samples is None:
            return None
        state, samples = self._smoother.state, self.self_calibration.correct(samples)
        motion = preintegrate(samples, state.bias, self._calibration, self._config.smoother.imu_inflation)
        T_m_b, velocity = motion.propagate(state.T_m_b, state.velocity, state.bias, self._smoother.gravity)
        T_m_b, rate = se3.orthonormalise(T_m_b), samples.gyro[-1] - state.bias[:3]
        return InertialMotion(T_m_b, velocity, rate, self._growth(state, motion))

    def _growth(self, state: InertialState, motion: Preintegrated) -> F64:
        """Covariance (6,6) of the motion after a state: errors of velocity, biases and vertical, and noise."""
        dt, r, cov = motion.dt_s, state.T_m_b[:3, :3], state.cov
        level = self._config.gravity_m_s2**2 * float(np.trace(cov[15:, 15:]) + np.trace(cov[:3, :3])) * np.eye(3)
        out = np.zeros((6, 6))
        out[:3, :3] = dt**2 * cov[6:9, 6:9] + r @ motion.cov[6:9, 6:9] @ r.T
        out[:3, :3] += (0.5 * dt * dt) ** 2 * (r @ cov[12:15, 12:15] @ r.T + level)
        out[3:, 3:] = motion.cov[:3, :3] + dt**2 * cov[9:12, 9:12]
        return out

    def update(
        self, t_ns: int, T_m_b_visual: F64, points: VisualPoints, velocity: BodyVelocity | None = None
    ) -> InertialState | None:
        """Fuse a frame placed by images.

        T_m_b_visual: (4,4) by images alone, from `points`. velocity: by an odometer. Returns the fused state; None
        before the initialisation and without samples, when the pose from images stands.
        """
        stamp_ns, t_ns = t_ns, self.clock.taken_ns(t_ns)
        samples, depth_m = self._interval(t_ns), points.depth_m(T_m_b_visual)
        compared = None if self.self_calibration.awaits_search else samples
        self.clock.judge(stamp_ns, T_m_b_visual[:3, :3], compared, self._bias, self._calibration)
        if samples is not None:
            self._calibrate(t_ns, T_m_b_visual, depth_m, samples.duration_s)
            if self.self_calibration.awaits_search:
                self._smoother.stop()
            if self.self_calibration.restarted or self.self_calibration.awaits_search:
                samples = None
        state = None
        if self._smoother.running:
            awaits = self._awaited(samples) is not None
            held = without_held(samples) if samples and awaits else samples
            length_error = disparity_offset.GOOD_PX * depth_m / self._bf if self._images_have_scale else 0.0
            state = self._advance(held, points, velocity, length_error)
        self._scale_watch.see(t_ns, T_m_b_visual, depth_m, state)
        if state is None:
            self._initialiser.add(TimedPose(t_ns, T_m_b_visual.copy(), samples, self._awaited(samples)))
            self._set_last(t_ns, T_m_b_visual)
            if self.metric:
                self.started = self._initialiser.start(self._smoother, self._bias) or self.started
        else:
            self._set_last(t_ns, state.T_m_b)
        self._image_loss_s = 0.0
        return state

    def dead_reckon(self, t_ns: int, velocity: BodyVelocity | None = None) -> InertialState | None:
        """Propagate the state over a frame without a pose from images.

        Returns the state with its growing covariance; None if it is unknown, samples are missing, or images were lost
        for too long.
        """
        t_ns = self.clock.taken_ns(t_ns)
        samples = self._interval(t_ns)
        self.clock.forget()
        self.self_calibration.clear()
        self._initialiser.clear()
        self._scale_watch.forget()
        if self._last is not None:
            self._image_loss_s += (t_ns - self._last[0]) * 1e-9
        state = None
        if self._smoother.running and self._image_loss_s <= self._config.max_dead_reckoning_s:
            state = self._advance(samples, None, velocity)
        if state is None:
            self._smoother.stop()
            if self._last is not None:
                self._set_last(t_ns, self._last[1])
            return None
        self._set_last(t_ns, state.T_m_b)
        return state

    # map changes

    def move_map(self, T_new_old: F64) -> None:
        """Transform the state after the map moved: p_new = T_new_old p_old."""
        self.clock.forget()
        self._smoother.move_map(T_new_old)
        self._initialiser.transform(lambda T_m_b: T_new_old @ T_m_b)
        if self._last is not None:
            self._last = (self._last[0], T_new_old @ self._last[1])
        self.self_calibration.move_map(T_new_old)
        self._scale_watch.move_map(T_new_old)

    def scale_map(self, factor: float) -> None:
        """Lengths in a monocular map were multiplied by `factor` about the camera of the last frame."""
        if self._last is None or not self._smoother.running:
            return
        camera = self._last[1][:3, 3] + self._last[1][:3, :3] @ self._p_b_c
        self._smoother.scale_map(factor, camera)
        self._scale_watch.scale_map(factor, camera)

    def begin_map(self, t_ns: int, T_m_b: F64) -> None:
        """Begin a new map at this frame, with the body at T_m_b (4,4) by definition.

        Velocity, gravity and biases are kept if the smoother runs; else the initialisation begins again.
        """
        t_ns = self.clock.taken_ns(t_ns)
        self.clock.forget()
        if self._smoother.running:
            self._smoother.begin_map(T_m_b)
        self.self_calibration.begin_map()
        self._scale_watch.forget()
        self._incomplete = []
        self._initialiser.clear()
        self._set_last(t_ns, T_m_b)
        self._image_loss_s = 0.0
        if not self._smoother.running:
            self._initialiser.add(TimedPose(t_ns, T_m_b.copy(), None))

    def start(self, t_ns: int, T_m_b: F64, start: InertialStartState) -> None:
        """Begin a map in metres at this frame, with the body at T_m_b (4,4) by definition, in a known state."""
        self.metric, self.started = True, "motion"
        self._bias = start.bias.copy()
        if start.offset is not None:
            self.self_calibration.begin_with_offset(start.offset)
        self._smoother.start(start.T_w_b, start.velocity, start.bias, start.gravity, StartDeviations(), start.cov)
        self.begin_map(t_ns, T_m_b)
        state = self._smoother.state
        self.scale.start(state.velocity, self._smoother.gravity, state.bias, start.accel_noise)
        self._scale_watch.begin()

    def reset(self) -> None:
        """Begin a new map at an unknown pose relative to the old one. Biases are kept."""
        self._smoother.stop()
        self._initialiser.clear()
        self.scale.stop()
        self.clock.forget()
        self._last = None
        self.self_calibration.begin_map()
        self._incomplete = []
        self._image_loss_s = 0.0

    def rescale(self, scale: float) -> None:
        """Scale the map by `scale`, so that it is metric from now on."""
        self.metric = True
        self._initialiser.transform(lambda T_m_b: camera_scaled(T_m_b, scale, self._p_b_c))
        if self._last is None:
            return
        self._last = (self._last[0], camera_scaled(self._last[1], scale, self._p_b_c))
        self._scale_watch.forget()
        self.scale.correct(scale)
        if self._smoother.running:
            state, gravity = self._smoother.state, self._smoother.gravity
            velocity = scale * state.velocity
            self._smoother.start(self._last[1], velocity, state.bias, gravity, StartDeviations(), state.cov)
            self.scale.resume(velocity)

    # steps

    def _interval(self, t_ns: int) -> Samples | None:
        """Corrected samples from the last frame to this one, on the IMU's clock."""
        if self._last is None:
            return None
        begin = self._interval_end_ns if self._interval_end_ns else self._last[0] + self._offset_ns
        return self._between(begin, t_ns + self._offset_ns)

    def _awaited(self, samples: Samples | None) -> tuple[int, int] | None:
        """Begin and end of the last interval, IMU time, if its last samples have not come yet."""
        if samples is None:
            return None
        end_ns = self._interval_end_ns + round(samples.duration_s * 1e9)
        return (self._interval_end_ns, end_ns) if self._buffer.lacks(end_ns) else None

    def samples_between(self, from_ns: int, to_ns: int) -> Samples | None:
        """Corrected samples between two camera stamps; None with a gap, and before the last ones have come."""
        from_ns, to_ns = self.clock.taken_ns(from_ns), self.clock.taken_ns(to_ns)
        return self._between_frames(from_ns, to_ns) if self._has_come(to_ns) else None

    def has_samples(self, t_ns: int) -> bool:
        """True if the samples up to a camera stamp have come, but for one or two."""
        return self._has_come(self.clock.taken_ns(t_ns))

    def _has_come(self, t_ns: int) -> bool:
        """True if the samples up to a frame's time have come, but for one or two."""
        return not self._buffer.lacks_some(t_ns + self._offset_ns)

    def _between_frames(self, from_ns: int, to_ns: int) -> Samples | None:
        return self._between(from_ns + self._offset_ns, to_ns + self._offset_ns)

    def _between(self, from_ns: int, to_ns: int) -> Samples | None:
        """Corrected samples; cached, as the prediction and the update of a frame need the same ones."""
        key = (from_ns, to_ns, self._buffer.newest_t_ns)
        if self._cached is None or self._cached[0] != key:
            samples = self._buffer.between(from_ns, to_ns)
            self._cached = key, None if samples is None else self.self_calibration.correct(samples)
        return self._cached[1]

    @property
    def _offset_ns(self) -> int:
        return int(self.self_calibration.offset_s * 1e9)

    def _set_last(self, t_ns: int, T_m_b: F64) -> None:
        self._last = (t_ns, T_m_b.copy())
        self._interval_end_ns = t_ns + self._offset_ns

    def _advance(
        self, samples: Samples | None, points: VisualPoints | None, velocity: BodyVelocity | None,
        length_error: float = 0.0,
    ) -> InertialState | None:  # fmt: skip
        if samples is None:
            self._smoother.stop()
            return None
        self._complete_intervals()
        state = self._smoother.add(samples, points, velocity, length_error)
        if state is not None:
            self._bias = state.bias
        end_ns = self._interval_end_ns + round(samples.duration_s * 1e9)
        newest = self._buffer.newest_t_ns
        if newest is not None and newest < end_ns:
            self._incomplete.append((self._interval_end_ns, end_ns))
        self._smoother.hold(len(self._incomplete))
        return state

    def _complete_intervals(self) -> None:
        """Replace the last intervals whose final samples came after their frames: IMU stamps ahead of the camera's.

        What still has not come counts next to nothing: forces held for more than a frame would turn the vertical.
        """
        newest, intervals = self._buffer.newest_t_ns, self._incomplete
        for back, (begin_ns, end_ns) in enumerate(reversed(intervals)):
            samples = self._between(begin_ns, end_ns)
            if samples is not None:
                lacks = self._buffer.lacks(end_ns)
                self._smoother.replace(back, without_held(samples) if lacks else samples)
        self._incomplete = [i for i in intervals[-MOST_STATES:] if newest is not None and newest < i[1]]

    def _calibrate(self, t_ns: int, T_m_b_visual: F64, depth_m: float, dt_s: float) -> None:
        gravity = self._smoother.gravity if self._smoother.running and self._images_have_scale else None
        self.self_calibration.add(t_ns, T_m_b_visual, depth_m)
        change = self.self_calibration.update(self._buffer, gravity, dt_s)
        if self.self_calibration.restarted:
            self._smoother.stop()
            self._initialiser.clear()
            self._bias = np.concatenate([self.self_calibration.gyro.bias, np.zeros(3)])
            self._cached, self._incomplete = None, []
        elif change.any():
            self._bias = np.concatenate([self._bias[:3], self._bias[3:] + change])
            self._smoother.shift_accel_bias(change)
        applied = self.self_calibration
        walk = self._relaxation.walk(applied.offset_s, applied.gyro_matrix, applied.accel_matrix, dt_s)
        self._smoother.extra_walk = walk

"""Motion model of the tracker: IMU, odometer or constant velocity."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kiteline_agent.config import OdometerConfig
from kiteline_agent.covariance.calibration_error_kernels import adjoint
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_agent.inertial.clocks.sample_clock import SampleClock
from kiteline_agent.inertial.fixed_lag import VisualPoints
from kiteline_agent.inertial.gravity_alignment import up_of
from kiteline_agent.inertial.imu_initialisation import InertialStartState
from kiteline_agent.inertial.inertial_config import InertialConfig
from kiteline_agent.inertial.inertial_tracker import InertialTracker
from kiteline_agent.inertial.samples.imu_watch import SILENT_S, ImuWatch
from kiteline_agent.inertial.samples.sample_check import SampleCheck
from kiteline_agent.inertial.scale_filter import INTERVAL_S, ScaleFilter, correction_due
from kiteline_agent.motion.extrapolation import Extrapolation, MotionSource, along_twist
from kiteline_agent.motion.joint_scale import JointScale
from kiteline_agent.motion.loss_motion import LossMotionEstimator
from kiteline_agent.motion.odometer import Odometer
from kiteline_agent.motion.step_recorder import StepRecorder
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_agent.tracking.track import Track
from kiteline_codec.schema import InertialSteps
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, ImuCalibration, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import KeyframeId

_CONTRADICTS = (
    "imu: contradicts the images and is not used any more in this flight, the images alone carry the pose: check the "
    "camera's place in the IMU's axes (T_BS), the time offset and the units (rad/s, m/s^2)"
)
_NO_VERTICAL = "imu: the vertical is not known: a flight controller gets no poses, and no ground is found"
_MOST_UP_RAD = 0.2  # deviation of a direction of gravity that is of use
_TRUSTED_S = 1.0  # s for which dead reckoning counts as tracking


@dataclass(frozen=True, slots=True)
class DeadReckoning:
    """Pose of a frame that the images did not place.

    T_m_c: (4,4). cov: (6,6) of it, None if neither IMU nor odometer measures the motion. trusted: dead reckoning has
    lasted for a short time only. told: a sensor has told the motion of this frame; an odometer that slips or has fallen
    silent has a covariance all the same.
    """

    T_m_c: F64
    cov: F64 | None
    trusted: bool
    told: bool


class MotionModel:
    """Predicts camera poses and fuses measured ones with an IMU and an odometer, if the vehicle has them."""

    def __init__(
        self, camera: RectifiedCamera, imu: ImuCalibration | None, config: InertialConfig, odometer: OdometerConfig,
        pose: PoseState, *, metric: bool,
    ) -> None:  # fmt: skip
        """metric: the cameras alone measure in metres (stereo or depth)."""
        self._T_b_c, self._T_c_b = camera.T_b_c, se3.inverse(camera.T_b_c)
        self._pose = pose
        self._metric = metric
        self.tracker = None if imu is None else InertialTracker(camera, imu, config, metric=metric)
        self._steps = None if imu is None or metric else StepRecorder(imu, INTERVAL_S)
        self.loss_motion: LossMotionEstimator | None = None
        if self.tracker is not None and imu is not None and metric:
            self.loss_motion = LossMotionEstimator(self.tracker, imu, config.gravity_m_s2)
        self.odometer = Odometer(camera.T_b_c, odometer, metric=metric)
        self._joint_scale = JointScale()
        self._sample_clock, self._sample_check = SampleClock(), SampleCheck()
        self._watch = ImuWatch(SILENT_S, config.gravity_m_s2)
        self._events: list[str] = []
        self.rough_unit: float | None = None  # relative deviation of lengths, of a map whose metre is told roughly
        self.has_false_vertical = False  # it came from an IMU that never agreed with the images

    @property
    def running(self) -> bool:
        """True if the IMU state is initialised, so that dead reckoning is possible."""
        return self.tracker is not None and self.tracker.running

    @property
    def measures_motion(self) -> bool:
        """True if a sensor other than the camera measures the motion."""
        return self.running or self.odometer.predicts

    @property
    def told(self) -> bool:
        """True if a sensor has told the motion of the last frame: an odometer that fell silent, or slips, has not."""
        return self.running or self.odometer.used

    @property
    def metric(self) -> bool:
        """True if the map's lengths are in metres."""
        return self._metric or self.odometer.metric or (self.tracker is not None and self.tracker.metric)

    @property
    def in_metres(self) -> bool:
        """True if lengths are in metres, if only as roughly as `scale_sigma` says."""
        return self.metric or self.rough_unit is not None

    @property
    def scale_sigma(self) -> float:
        """Relative deviation of the map's lengths in metres; 0 where images measure them, or in a unit of its own."""
        if self._metric or not self.metric:
            return self.rough_unit or 0.0
        by_imu = self._scale_by_imu
        if by_imu is None:
            return self.odometer.deviation
        told = self.odometer.map_scale
        return by_imu.deviation if told is None else self._joint_scale.deviation(by_imu.scale, told)

    @property
    def _scale_by_imu(self) -> ScaleFilter | None:
        """What watches the scale of a monocular map whose metre the IMU told; None where the odometer did."""
        running = self.tracker is not None and self.tracker.scale.running
        return self.tracker.scale if self.tracker is not None and running else None

    @property
    def has_scale_by_imu(self) -> bool:
        """True if the IMU tells the scale of a monocular map, or images do."""
        return self._metric or self._scale_by_imu is not None

    @property
    def awaits_scale(self) -> bool:
        """True if lengths are not in metres yet, but the odometer may still give the scale."""
        return not self.in_metres and self.odometer.awaits_scale

    @property
    def velocity_sigma(self) -> float:
        """Largest deviation of the velocity that a sensor told in the last frame, m/s in a direction."""
        state = None if self.tracker is None else self.tracker.state
        cov = self.odometer.velocity_cov if state is None else state.cov[6:9, 6:9]
        return float(np.sqrt(max(np.linalg.eigvalsh(cov)[-1], 0.0)))

    @property
    def has_turned_imu(self) -> bool:
        """True after a frame by which the IMU turned out to be mounted otherwise than the calibration says."""
        return self.tracker is not None and self.tracker.self_calibration.turned

    def known_imu(self) -> KnownImuConfig | None:
        """What is known of the IMU, for the next flight; None before anything was measured."""
        return None if self.tracker is None else self.tracker.self_calibration.known()

    def ignore_imu(self) -> None:
        """Go on as without an IMU: its samples contradict the images."""
        self.tracker = self._steps = self.loss_motion = None

    def see(self, t_ns: int) -> None:
        """A frame with this stamp has come, whether or not it is tracked."""
        if self.tracker is not None:
            self.tracker.clock.add(t_ns)

    def timed(self, imu: ImuBatch | None) -> ImuBatch | None:
        """New samples that a motion explains, with the times at which they were taken."""
        return imu if self.tracker is None else self._sample_check.checked(self._sample_clock.timed(imu))

    def add_odometry(self, odometry: OdometryBatch | None) -> None:
        """Buffer the odometer samples since the last step."""
        self.odometer.add(odometry)

    def predict(self, t_ns: int, imu: ImuBatch | None, dt_s: float) -> F64:
        """Predict T_m_c (4,4) of a frame from the IMU, else the odometer, else constant velocity.

        A gyro alone tells the rotation.
        """
        turn = None
        if self.tracker is not None:
            self._events += self._watch.frame(t_ns, imu)
            T_m_b = self.tracker.predict(imu, t_ns)
            if T_m_b is not None:
                return se3.orthonormalise(T_m_b @ self._T_b_c)
            turn = self.tracker.turn(t_ns)
        predicted = self.odometer.predict(self._pose.T_m_c, t_ns)
        if predicted is None and turn is not None:
            return self._pose.predict_turned(dt_s, self._T_c_b[:3, :3] @ turn @ self._T_b_c[:3, :3])
        return self._pose.predict(dt_s) if predicted is None else predicted

    def extrapolate(self, t_ns: int, imu: ImuBatch | None, dt_s: float) -> Extrapolation:
        """The body dt_s after the last frame, from IMU, else odometer, else constant velocity. No state changes.

        imu: samples since the last frame.
        """
        inertial = None if self.tracker is None else self.tracker.extrapolate(imu, t_ns)
        if inertial is not None:
            return Extrapolation(inertial.T_m_b, inertial.velocity, inertial.rate, inertial.growth, MotionSource.IMU)
        T_m_b = self._pose.T_m_c @ self._T_c_b
        driven = self.odometer.extrapolate(T_m_b, t_ns)
        if driven is not None:
            return driven
        twist = adjoint(self._T_b_c) @ self._pose.twist(dt_s)
        return along_twist(T_m_b, twist, dt_s, None, MotionSource.VELOCITY)

    def camera_twist(self, t_ns: int, dt_s: float) -> F64:
        """Twist (6,) [m/s, rad/s] of the camera in its own axes at a frame, after `predict` was called for it."""
        moved = self.extrapolate(t_ns, None, dt_s)
        R_b_m, R_c_b = moved.T_m_b[:3, :3].T, self._T_c_b[:3, :3]
        linear = R_b_m @ moved.velocity + np.cross(moved.rate, self._T_b_c[:3, 3])
        return np.concatenate([R_c_b @ linear, R_c_b @ moved.rate])

    def fuse(self, track: Track, t_ns: int) -> Track:
        """Fuse the pose from images with IMU and odometer; returns the track with the fused pose."""
        state = None
        if self.tracker is not None:
            points = VisualPoints(track.xyz, track.ray, track.observed, track.sigma_px, track.inlier)
            velocity = self.odometer.velocity(t_ns)
            T_m_b = se3.inverse(track.T_c_m) @ self._T_c_b
            state = self.tracker.update(t_ns, T_m_b, points, velocity)
            if self._steps is not None and self.tracker.metric and state is not None:
                self._steps.see(t_ns, T_m_b)
            if self._metric and self.tracker.self_calibration.contradicts:
                self._leave_imu(self.tracker)
                state = None
        if state is not None:
            track = replace(track, T_c_m=se3.inverse(state.T_m_b @ self._T_b_c))
        self.odometer.update(se3.inverse(track.T_c_m), t_ns)
        by_imu = self._scale_by_imu
        if by_imu is not None:
            self._events += self._joint_scale.watch(by_imu.scale, self.odometer.map_scale)
        return track

    def _leave_imu(self, tracker: InertialTracker) -> None:
        """Fly on by images that measure distances themselves."""
        self.has_false_vertical = not tracker.self_calibration.is_proved
        self.ignore_imu()
        self._events += [_CONTRADICTS, _NO_VERTICAL] if self.has_false_vertical else [_CONTRADICTS]

    def mark_keyframe(self, keyframe: KeyframeId, t_ns: int) -> None:
        """A keyframe was made of the frame at t_ns."""
        if self._steps is not None:
            self._steps.mark(keyframe, t_ns)

    def take_steps(self) -> list[InertialSteps]:
        """Steps between keyframes for the base, whose samples have come."""
        return [] if self._steps is None or self.tracker is None else self._steps.take(self.tracker)

    def up(self) -> tuple[F64, float] | None:
        """Unit vector (3,) against gravity in the camera, and its deviation about an axis, rad; None if unknown."""
        state = None if self.tracker is None else self.tracker.state
        if state is None:
            return None
        up, sigma = up_of(state)
        return (self._T_c_b[:3, :3] @ up, sigma) if 0.0 < sigma < _MOST_UP_RAD else None

    def take_events(self) -> list[str]:
        """Events since the last call, for the log."""
        events, self._events = self._events, []
        return (
            events
            + self.odometer.take_events()
            + self._sample_clock.take_events()
            + self._sample_check.take_events()
            + ([] if self.tracker is None else self.tracker.take_calibration_events())
        )

    def dead_reckon(self, predicted: F64, t_ns: int) -> DeadReckoning:
        """Process a frame without a pose from images, predicted at T_m_c (4,4)."""
        if self._steps is not None:
            self._steps.clear()
        if self.loss_motion is not None:
            self.loss_motion.clear()
        state = None if self.tracker is None else self.tracker.dead_reckon(t_ns, self.odometer.velocity(t_ns))
        if self.tracker is None or state is None:
            cov = self.odometer.dead_reckon(predicted, t_ns)
            trusted = self.odometer.used and self.odometer.image_loss_s <= _TRUSTED_S
            return DeadReckoning(predicted, cov, trusted, cov is not None and self.odometer.used)
        self.odometer.dead_reckon(state.T_m_b @ self._T_b_c, t_ns)
        trusted = self.tracker.image_loss_s <= _TRUSTED_S
        return DeadReckoning(state.T_m_b @ self._T_b_c, state.pose_cov, trusted, True)

    def restart(self, t_ns: int) -> None:
        """Move the inertial state to the current pose after a relocalisation or in a new map."""
        if self.tracker is not None:
            self.tracker.begin_map(t_ns, self._pose.T_m_c @ self._T_c_b)
        self._restart_steps(t_ns)
        self.odometer.restart(self._pose.T_m_c, t_ns)

    def move_map(self, T_new_old: F64, growth: float = 1.0) -> None:
        """Transform the state after the submap frame moved by T_new_old (4,4).

        growth: factor of lengths around the camera; not followed where images measure distances.
        """
        if self.tracker is not None:
            self.tracker.move_map(T_new_old)
        if self._steps is not None:
            self._steps.move_map(T_new_old)
        if self.tracker is not None and not self._metric:
            self.tracker.scale_map(growth)
        self.odometer.move_map(T_new_old, growth)

    def forget_turns(self) -> None:
        """Poses by images were those of a wrongly calibrated camera until now: they do not refute the IMU."""
        if self.tracker is not None:
            self.tracker.self_calibration.forget_turns()

    def begin_unscaled_map(self, sigma: float | None = None) -> None:
        """Begin a map of unknown scale. sigma: relative deviation of its lengths, if they are roughly in metres."""
        self.rough_unit = sigma
        self.odometer.set_metric(metric=False, rough=sigma is not None)
        if self._steps is not None:
            self._steps.clear()
        if self.tracker is not None:
            self.tracker.reset()
            self.tracker.metric = False

    def return_to_metres(self) -> None:
        """Continue in an older map in metres. `restart` follows."""
        self._set_metric()
        if self.tracker is not None:
            self.tracker.rescale(1.0)

    def begin_metric_map(self, t_ns: int, state: InertialStartState) -> None:
        """Begin a map in metres at the present pose, in a known inertial state."""
        assert self.tracker is not None
        self.tracker.start(t_ns, self._pose.T_m_c @ self._T_c_b, state)
        self._restart_steps(t_ns)
        self._set_metric()
        self.odometer.restart(self._pose.T_m_c, t_ns)

    def metres_per_unit(self, sigma: float) -> float | None:
        """Metres per unit of the map, once known to the relative deviation `sigma`.

        None before, and if lengths are in metres already.
        """
        if self.metric:
            return None
        found = self.odometer.metres_per_unit()
        return found[0] if found is not None and found[1] <= sigma * found[0] else None

    def scale_correction(self) -> tuple[float, float] | None:
        """Factor by which the map in metres is to be scaled, and its deviation; None if no correction is due."""
        if self._metric or not self.metric:
            return None
        by_imu = self._scale_by_imu
        if by_imu is None:
            return self.odometer.scale_correction()
        told = self.odometer.map_scale
        if told is None:
            return by_imu.correction()
        return correction_due(*self._joint_scale.fused(by_imu.scale, told), by_imu.age_s)

    def reports(self) -> dict[str, Any]:
        """What was found of time offset, IMU and odometer; None for each that is not there."""
        tracker = self.tracker
        return {
            "time_offset": None if tracker is None else tracker.offset_report(),
            "imu_calibration": None if tracker is None else tracker.self_calibration.report(),
            "odometer": self.odometer.report(),
        }

    def set_scale(self, t_ns: int, metres_per_unit: float, T_new_old: F64) -> None:
        """Scale the state to metres, in a submap that begins at this frame; the old one lies at T_new_old (4,4)."""
        self._set_metric(metres_per_unit if self.metric else 1.0)
        if self.tracker is not None:
            self.tracker.rescale(metres_per_unit)
            self.tracker.move_map(T_new_old)
        self._restart_steps(t_ns)

    def continue_map(self, t_ns: int, T_new_old: F64) -> None:
        """Continue in a submap that begins at this frame, in the same unit; the old one lies at T_new_old (4,4)."""
        self.move_map(T_new_old)
        self._restart_steps(t_ns)

    def _set_metric(self, factor: float = 1.0) -> None:
        """Lengths are in metres from now on. factor: as in `Odometer.set_metric`."""
        self.rough_unit = None
        self.odometer.set_metric(metric=True, factor=factor)

    def _restart_steps(self, t_ns: int) -> None:
        if self._steps is not None:
            self._steps.restart(t_ns, self._pose.T_m_c @ self._T_c_b)

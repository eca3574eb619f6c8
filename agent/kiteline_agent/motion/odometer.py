"""Motion from an odometer: checks it against the images, calibrates its scale, predicts and dead reckons poses.

While images place the vehicle, the odometer's displacement is compared with theirs over short windows. The comparison
gives the odometer's scale (tyre wear), its actual noise, and whether it may be used. Wheel slip, a dead sensor, wrong
stamps or swapped axes raise that noise; above a tolerance the odometer is not used until it agrees again.
"""

import numpy as np

from kiteline_agent.config import OdometerConfig
from kiteline_agent.inertial.fixed_lag import BodyVelocity
from kiteline_agent.inertial.samples.imu_watch import SILENT_S
from kiteline_agent.motion.extrapolation import Extrapolation, MotionSource, along_twist
from kiteline_agent.motion.odometer_samples import MeanVelocity, OdometerSamples, measured_part
from kiteline_agent.motion.odometer_scale import LEAST_MOVED_M, OdometerScale
from kiteline_agent.motion.unit_scale import WINDOW_S, UnitScale
from kiteline_agent.motion.velocity_update import KalmanUpdate, blend
from kiteline_core.arrays import F64
from kiteline_core.frame import OdometryBatch
from kiteline_core.geometry import se3

_UNMATCHED = 10  # windows without a sample, after which the stamps are reported to be wrong
_WELL = 0.09  # (m/s)^2 or (rad/s)^2; directions measured worse than this count less and less
_CORRELATION_S = 0.5  # s; correlation time of an odometer's errors: a patch of slippery floor, a gust
_COMPARE_S = 0.2  # s; window of a comparison, in which images measure a velocity to a centimetre a second
_UNIT_FLOOR = 0.01  # least relative deviation of a monocular map's unit
_START_M_S = 0.08  # m/s; expected noise at the start, weighted as one window
_START_RAD_S = 0.03  # rad/s; the same of the rotation rate
_MEMORY_S = 3.0  # s; time constant of the noise estimate
_UNUSUAL = 5.0  # times the expected squared error, above which `_RISE` applies
_TOLERANCE_SHARE = 0.10  # of the speed: noise above which an odometer is not used, beside tolerance_m_s
_PROOFS = 3  # consecutive moving windows that must agree before an odometer is used
_SURPRISE = 4.0  # deviations from the prediction above which a sample is rejected: 8 m/s^2
_SEEN_M_S = 0.05  # m/s; error of the velocity between two frames placed by images
_SEEN_RAD_S = 0.02  # rad/s; the same of the rotation rate
_RISE = 0.5  # weight of such an unusual error: a slip is detected within 0.2 s
_DOUBTED = 0.25  # relative deviation of lengths that odometer and images disagree on
_SETTLED = 0.4  # share of a rejected jump below which the velocity must fall before it is used again


class Odometer:
    """Call `predict` once a frame, then `update` with the measured pose or `dead_reckon` without one."""

    def __init__(self, T_b_c: F64, config: OdometerConfig, *, metric: bool) -> None:
        """T_b_c: (4,4) camera in the body. metric: the map's lengths are in metres."""
        self._T_b_c, self._T_c_b = T_b_c, se3.inverse(T_b_c)
        self._config = config
        self.metric = metric
        self._in_metres = metric  # if only roughly
        self._samples = OdometerSamples(config.keep_s, config.max_gap_s)
        self._scale = OdometerScale(of_map=not metric)
        self._noise, self._rate_noise = _START_M_S**2, _START_RAD_S**2  # variances
        self._proofs = 0
        self._anchor: tuple[int, F64] | None = None  # stamp and T_m_c at the start of the window
        self._last: tuple[int, F64] | None = None  # stamp and T_m_c of the last frame
        self._velocity, self._rate = np.zeros(3), np.zeros(3)  # in b
        self._accel = np.zeros(3)  # m/s^2, by which the velocity changed last
        self._velocity_cov, self._rate_cov = np.eye(3), np.eye(3)
        self._velocity_slow, self._rate_slow = np.eye(3), np.eye(3)  # correlated part of the covariances
        self._jump = 0.0  # m/s, largest rejected change of velocity; 0: none since it was last used
        self._alone_s = 0.0  # since a sample was last used
        self._carried = False  # the last prediction comes from the odometer
        self._gain = np.zeros((3, 3))  # Kalman gain (3,3) of that prediction, in b
        self.image_loss_s = 0.0
        self._path, self._path_cov, self._path_cross = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))  # in m
        self._rotation_cov, self._rotation_cross = np.zeros((3, 3)), np.zeros((3, 3))  # about the body's axes
        self._unit_scale = UnitScale()
        self.unit_sigma = 0.0  # relative deviation of metres per unit, once they were found
        self._unscaled_ns: int | None = None  # stamp of the first frame in a map of unknown scale
        self._trusted = self._reported_trust = False
        self._doubted = False  # it agreed with the images of this map, and does not any more
        self._unmatched = 0  # windows without a sample before the first comparison
        self._compared = 0

    # state

    def has_recent(self, t_ns: int) -> bool:
        """True if samples have come, the newest one less than SILENT_S before a frame."""
        newest_ns = self._samples.newest_ns
        return newest_ns is not None and t_ns - newest_ns < SILENT_S * 1e9

    @property
    def scale(self) -> float:
        """True velocity over the measured one."""
        return self._scale.value

    @property
    def deviation(self) -> float:
        """Relative deviation of lengths in a monocular map, once the odometer has told its unit."""
        lengths = max(_DOUBTED, self._scale.apart) if self._doubted else self._scale.deviation
        return float(np.hypot(self.unit_sigma, lengths))

    @property
    def map_scale(self) -> tuple[float, float] | None:
        """Metres per unit of a monocular map in metres, and the deviation; None while the odometer tells none."""
        speaks = self._last is not None and self.has_recent(self._last[0])
        return self._scale.of_map if speaks and self._trusted and self.metric else None

    @property
    def trusted(self) -> bool:
        """True if the odometer agreed with the images in the latest windows."""
        return self._trusted

    @property
    def used(self) -> bool:
        """True if the last prediction used a sample."""
        return self._carried and self._alone_s == 0.0

    @property
    def velocity_cov(self) -> F64:
        """(3,3) (m/s)^2 of the velocity in the last frame, in b."""
        return self._velocity_cov

    @property
    def predicts(self) -> bool:
        """True if the last prediction came from the odometer."""
        return self._carried

    def report(self) -> dict[str, float | bool] | None:
        """Scale, noise and state of the odometer for report.json; None without samples."""
        if not self._samples.any:
            return None
        return {
            "trusted": self._trusted,
            "scale": round(self.scale, 4),
            "scale_sigma": round(float(np.sqrt(self._scale.var)), 4),
            "noise_m_s": round(float(np.sqrt(self._noise)), 4),
            "compared": self._compared,
        }

    @property
    def awaits_scale(self) -> bool:
        """True in a map of unknown scale while the odometer may still give it."""
        if self.metric or not self._samples.any:
            return False
        if self._unscaled_ns is None or self._last is None:
            return True
        t_ns = self._last[0]
        return self.has_recent(t_ns) and t_ns - self._unscaled_ns < self._config.unit_wait_s * 1e9

    def take_events(self) -> list[str]:
        """Events since the last call, for the log."""
        if self._unmatched == _UNMATCHED:
            self._unmatched += 1
            return ["odometer: none of its stamps lies between those of frames, not used"]
        if self._trusted == self._reported_trust:
            return []
        self._reported_trust = self._trusted
        if self._trusted:
            return [f"odometer: agrees with what is seen, its scale is {self.scale:.3f}"]
        return [f"odometer: off by {np.sqrt(self._noise):.2f} m/s from what is seen, not used"]

    @property
    def _usable(self) -> bool:
        """True if poses can be predicted: samples agree with the images, and the map is in metres, if only roughly."""
        return self._samples.any and self._trusted and self._in_metres

    # per frame

    def add(self, batch: OdometryBatch | None) -> None:
        """Buffer samples."""
        if self._config.use:
            self._samples.add(batch)

    def predict(self, T_m_c: F64, t_ns: int) -> F64 | None:
        """Predict T_m_c (4,4) at t_ns from that of the last frame; None if the odometer cannot be used."""
        self._carried = False
        if not self._usable or self._last is None:
            return None
        before_ns = self._last[0]
        mean = self._samples.between(before_ns, t_ns)
        if mean is None and self.image_loss_s == 0.0:
            return None
        c, dt = self._config, (t_ns - before_ns) * 1e-9
        growth = dt * (dt + 2.0 * self._alone_s) * np.eye(3)  # of unmeasured velocity, by acceleration
        prior, rate_prior = self._velocity_cov + c.accel_m_s2**2 * growth, self._rate_cov + c.turn_rad_s2**2 * growth
        if mean is None or not self._correct_velocity(mean, prior, rate_prior, dt):
            self._alone_s += dt
            self._accel = np.zeros(3)
            self._velocity_cov = self._velocity_slow = prior
            self._rate_cov = self._rate_slow = rate_prior
            self._gain = np.zeros((3, 3))
        self._carried = True
        T_b0_b1 = se3.exp(dt * np.concatenate([self._velocity, self._rate]))
        return se3.orthonormalise(T_m_c @ self._T_c_b @ T_b0_b1 @ self._T_b_c)

    def extrapolate(self, T_m_b: F64, t_ns: int) -> Extrapolation | None:
        """The body at t_ns, after the last frame at T_m_b (4,4). No state changes; None if it cannot be used."""
        if not self._usable or self._last is None:
            return None
        c, dt = self._config, (t_ns - self._last[0]) * 1e-9
        mean = self._samples.between(self._last[0], t_ns)
        if mean is None or dt <= 0.0:
            return None
        update = self._updated_velocity(mean, self._velocity_cov + (c.accel_m_s2 * dt) ** 2 * np.eye(3))
        rate = self._updated_rate(mean, self._rate_cov + (c.turn_rad_s2 * dt) ** 2 * np.eye(3))
        r, growth = T_m_b[:3, :3], np.zeros((6, 6))
        growth[:3, :3], growth[3:, 3:] = dt**2 * (r @ update.cov @ r.T), dt**2 * rate.cov
        twist = np.concatenate([update.value, rate.value])
        return along_twist(T_m_b, twist, dt, growth, MotionSource.ODOMETER)

    def _correct_velocity(self, mean: MeanVelocity, prior: F64, rate_prior: F64, dt_s: float) -> bool:
        """Kalman update of the velocity; False if the sample is rejected: a wheel slips or the sensor is dead.

        A vehicle that speeds up goes on doing so: a slip begins at once.
        """
        update = self._updated_velocity(mean, prior)
        if not update.accepted:
            update = self._updated_velocity(mean, prior, self._velocity + dt_s * self._accel)
        jump = float(np.linalg.norm(self.scale * mean.velocity - self._velocity))
        if not update.accepted or jump > _SETTLED * self._jump > 0.0:
            self._jump = max(self._jump, jump) if self.image_loss_s > 0.0 else 0.0
            return False
        self._jump = self._alone_s = 0.0
        self._accel = (update.value - self._velocity) / dt_s
        self._velocity, self._velocity_cov, self._velocity_slow = update.value, update.cov, update.slow
        self._gain = update.gain
        update = self._updated_rate(mean, rate_prior)
        self._rate, self._rate_cov, self._rate_slow = update.value, update.cov, update.slow
        return True

    def _updated_velocity(self, mean: MeanVelocity, prior: F64, expected: F64 | None = None) -> KalmanUpdate:
        """The velocity (3,) in b by a sample. prior: (3,3) its covariance before. expected: (3,); None: as it was."""
        c, z = self._config, self.scale * mean.velocity
        slow = (self._noise + c.floor_m_s**2) * np.eye(3) + self._scale.var * np.outer(z, z)
        return blend(self._velocity if expected is None else expected, prior, z, mean.velocity_cov, slow, _SURPRISE)

    def _updated_rate(self, mean: MeanVelocity, prior: F64) -> KalmanUpdate:
        """The same of the rate (3,), never rejected: a gust turns the vehicle at once."""
        slow = (self._rate_noise + self._config.floor_rad_s**2) * np.eye(3)
        return blend(self._rate, prior, mean.rate, mean.rate_cov, slow, np.inf)

    def update(self, T_m_c: F64, t_ns: int) -> None:
        """Process a frame that images (and an IMU) placed at T_m_c (4,4)."""
        if self._samples.any:
            self._compare(T_m_c, t_ns)
            if self._last is not None and t_ns > self._last[0] and self.image_loss_s == 0.0 and self._in_metres:
                self._set_velocity(self._last[1], T_m_c, (t_ns - self._last[0]) * 1e-9)
        self._last = (t_ns, T_m_c)
        if self._unscaled_ns is None and not self.metric:
            self._unscaled_ns = t_ns
        if self.image_loss_s > 0.0:
            self._reset_image_loss()

    def dead_reckon(self, T_m_c: F64, t_ns: int) -> F64 | None:
        """Process a frame that no image placed, assumed at T_m_c (4,4).

        Returns the covariance (6,6) of the body's motion since images were lost, [translation in m, rotation about the
        body's axes]; None if the prediction did not come from the odometer.
        """
        self._anchor = None
        before, self._last = self._last, (t_ns, T_m_c)
        if before is None:
            return None
        dt = (t_ns - before[0]) * 1e-9
        self.image_loss_s += dt
        if not self._carried:
            return None
        r = T_m_c[:3, :3] @ self._T_c_b[:3, :3]
        ended = min(dt / _CORRELATION_S, 1.0)  # share of the errors that decorrelated
        relax = ended * (r @ self._gain @ r.T)
        self._path = self._path + (T_m_c[:3, 3] - before[1][:3, 3])
        self._path_cross = self._path_cross + dt * (r @ self._velocity_slow @ r.T) - relax @ self._path_cross
        self._path_cov = self._path_cov + dt * (self._path_cross + self._path_cross.T)
        rotation_cross = self._rotation_cross if self._alone_s > 0.0 else (1.0 - ended) * self._rotation_cross
        self._rotation_cross = rotation_cross + dt * self._rate_slow
        self._rotation_cov = self._rotation_cov + dt * (self._rotation_cross + self._rotation_cross.T)
        arm = se3.skew(self._path)
        cov = np.zeros((6, 6))
        cov[:3, :3] = self._path_cov + self._scale.var * np.outer(self._path, self._path)
        cov[:3, :3] += arm @ r @ self._rotation_cov @ r.T @ arm.T / 3.0  # heading error along the path
        cov[3:, 3:] = self._rotation_cov
        return 0.5 * (cov + cov.T)

    def mean_between(self, from_ns: int, to_ns: int) -> MeanVelocity | None:
        """Means of the samples between two stamps, as they were measured; None with a gap."""
        return self._samples.between(from_ns, to_ns)

    def velocity(self, t_ns: int) -> BodyVelocity | None:
        """Velocity for the inertial smoother at the frame t_ns; None if the odometer is not trusted."""
        c = self._config
        if not self._samples.any or not self._trusted or not self.metric or self._last is None:
            return None
        before_ns = self._last[0]
        newest = self._samples.within(before_ns, t_ns)
        if newest is None:
            return None
        value, cov, age_s = self.scale * newest[0], newest[1], newest[2]
        dt = (t_ns - before_ns) * 1e-9
        # errors are correlated over frames: inflate, so that those frames count as one
        slow = (self._noise + c.floor_m_s**2) * np.eye(3) + self._scale.var * np.outer(value, value)
        counted = cov + max(1.0, 2.0 * _CORRELATION_S / dt) * slow
        return BodyVelocity(value, cov + slow, counted, age_s)

    # map changes

    def restart(self, T_m_c: F64, t_ns: int) -> None:
        """Continue from T_m_c (4,4) after a relocalisation or in a new map."""
        self._anchor, self._last = (t_ns, T_m_c), (t_ns, T_m_c)
        self._reset_image_loss()

    def scale_correction(self) -> tuple[float, float] | None:
        """Factor by which a monocular map in metres is to be scaled, and its deviation; None if none is due."""
        return self._scale.correction(believed=self._trusted) if self.metric else None

    def move_map(self, T_new_old: F64, growth: float = 1.0) -> None:
        """Transform the state after the submap frame moved by T_new_old (4,4), and lengths in it grew by a factor."""
        self._scale.scale_map(growth)
        self._anchor = None if self._anchor is None else (self._anchor[0], T_new_old @ self._anchor[1])
        self._last = None if self._last is None else (self._last[0], T_new_old @ self._last[1])
        r = T_new_old[:3, :3]
        self._path = r @ self._path
        self._path_cov, self._path_cross = r @ self._path_cov @ r.T, r @ self._path_cross @ r.T

    def set_metric(self, *, metric: bool, factor: float = 1.0, rough: bool = False) -> None:
        """Change the map's unit to metres, or to an unknown one, or to metres that are known roughly.

        factor: by which a map in metres was scaled.
        """
        if metric:
            self._scale.begin(factor)
        else:
            self._scale = OdometerScale(of_map=True)
        found = self.metres_per_unit()
        if metric and found is not None:
            self.unit_sigma = float(np.hypot(found[1] / found[0], _UNIT_FLOOR))
        self.metric, self._in_metres = metric, metric or rough
        self._anchor = self._last = None
        self._unit_scale.clear()
        self._unscaled_ns, self._doubted = None, False
        self._reset_image_loss()

    def metres_per_unit(self) -> tuple[float, float] | None:
        """Metres per unit of the map and its standard deviation; None while unknown."""
        return self._unit_scale.metres_per_unit()

    # steps

    def _reset_image_loss(self) -> None:
        self.image_loss_s = self._jump = self._alone_s = 0.0
        self._path, self._path_cov, self._path_cross = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        self._rotation_cov, self._rotation_cross = np.zeros((3, 3)), np.zeros((3, 3))

    def _set_velocity(self, before: F64, after: F64, dt_s: float) -> None:
        """Set the velocity to that between two frames placed by images."""
        twist = se3.log(self._T_b_c @ se3.inverse(before) @ after @ self._T_c_b) / dt_s
        self._accel = (twist[:3] - self._velocity) / dt_s
        self._velocity, self._rate = twist[:3], twist[3:]
        self._velocity_cov, self._rate_cov = _SEEN_M_S**2 * np.eye(3), _SEEN_RAD_S**2 * np.eye(3)

    def _compare(self, T_m_c: F64, t_ns: int) -> None:
        """Compare the odometer with the images once the window is long enough."""
        if self._anchor is None or t_ns <= self._anchor[0]:
            self._anchor = (t_ns, T_m_c)
            return
        before_ns, before = self._anchor
        dt = (t_ns - before_ns) * 1e-9
        if dt < (_COMPARE_S if self.metric else WINDOW_S) - 1e-3:
            return
        self._anchor = (t_ns, T_m_c)
        mean = self._samples.between(before_ns, t_ns)
        if mean is None:
            self._unmatched += self._compared == 0
            return
        self._compared += 1
        T_c0_c1 = se3.inverse(before) @ T_m_c
        # Rotation is taken from the images, so that only the odometer's velocity is compared.
        r_c_b = self._T_c_b[:3, :3]
        turn = self._T_b_c[:3, :3] @ se3.so3_log(T_c0_c1[:3, :3])
        lever_motion = (self._T_c_b @ se3.exp(np.concatenate([np.zeros(3), turn])) @ self._T_b_c)[:3, 3]
        moved = r_c_b @ se3.exp(np.concatenate([dt * mean.velocity, turn]))[:3, 3]
        known = measured_part(r_c_b @ mean.velocity_cov @ r_c_b.T, _WELL)
        if not self.metric:
            self._unit_scale.add(known @ (moved + lever_motion), known @ T_c0_c1[:3, 3])
            return
        self._compare_displacements(known @ moved, known @ (T_c0_c1[:3, 3] - lever_motion), float(np.trace(known)), dt)
        known = measured_part(mean.rate_cov, _WELL)
        error = known @ (mean.rate - turn / dt)
        square = float(error @ error) / max(float(np.trace(known)), 0.5)
        self._rate_noise = self._filtered(self._rate_noise, square, dt)

    def _compare_displacements(self, by_odometer: F64, by_images: F64, axes: float, dt: float) -> None:
        """Update scale, noise and trust from displacements (3,) in m, in the `axes` that are measured."""
        distance = float(np.sqrt(by_images @ by_images))
        self._scale.add(by_odometer, by_images, dt, float(np.sqrt(self._noise)))
        error = (by_images - self.scale * by_odometer) / dt
        tolerance = self._config.tolerance_m_s + _TOLERANCE_SHARE * distance / dt
        square_error = float(error @ error) / max(axes, 0.5)
        if max(distance, float(np.sqrt(by_odometer @ by_odometer))) > LEAST_MOVED_M:
            self._proofs = min(self._proofs + 1, _PROOFS) if square_error < tolerance**2 else 0
        self._noise = self._filtered(self._noise, square_error, dt)
        trusted, self._trusted = self._trusted, self._proofs >= _PROOFS and self._noise < tolerance**2
        self._doubted = not self._trusted and (trusted or self._doubted)

    def _filtered(self, before: float, square: float, dt: float) -> float:
        """Noise variance after a squared error, with a faster rise for unusual ones."""
        usual = max(1.0 - float(np.exp(-dt / _MEMORY_S)), 1.0 / (self._compared + 1.0))
        share = max(usual, _RISE) if square > _UNUSUAL * before else usual
        return before + share * (square - before)

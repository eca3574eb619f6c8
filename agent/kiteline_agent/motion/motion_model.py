"""What IMU and odometer add to tracking, where there are any; without them, constant velocity and the images alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

from numpy import float64
from numpy.typing import NDArray

from kiteline_agent.inertial.fixed_lag import VisualPoints
from kiteline_agent.inertial.imu_watch import ImuWatch
from kiteline_agent.inertial.inertial_tracker import InertialConfig, InertialTracker
from kiteline_agent.motion.odometer import Odometer, OdometerConfig
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_agent.tracking.track import Track
from kiteline_core.frame import ImuBatch, ImuCalibration, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera

F64 = NDArray[float64]


@dataclass(frozen=True, slots=True)
class Coasted:
    """A frame that no image placed. T_m_c: (4,4). cov: (6,6) of it, None where neither IMU nor odometer knows. trusted:
    they have carried it for a short while only.
    """

    T_m_c: F64
    cov: F64 | None
    trusted: bool


class Inertia:
    """Camera poses in, camera poses out, with an IMU and an odometer or without."""

    def __init__(
        self, camera: RectifiedCamera, imu: ImuCalibration | None, config: InertialConfig, odometer: OdometerConfig,
        pose: PoseState, *, metric: bool,
    ) -> None:  # fmt: skip
        """metric: whether the cameras alone measure in metres."""
        self._T_b_c, self._T_c_b = camera.T_b_c, se3.inverse(camera.T_b_c)
        self._config = config
        self._pose = pose
        self._metric = metric
        self.tracker = None if imu is None else InertialTracker(camera, imu, config, metric=metric)
        self.odometer = Odometer(camera.T_b_c, odometer, metric=metric)
        self._watch = ImuWatch(config.silent_s)
        self._news: list[str] = []

    @property
    def running(self) -> bool:
        """Whether the IMU could carry the pose."""
        return self.tracker is not None and self.tracker.running

    @property
    def carried(self) -> bool:
        """Whether something else than images tells where the vehicle goes."""
        return self.running or self.odometer.carries

    @property
    def metric(self) -> bool:
        """Whether lengths are metres."""
        return self._metric or self.odometer.metric or (self.tracker is not None and self.tracker.metric)

    def hear(self, driven: OdometryBatch | None) -> None:
        """What an odometer said since the last step."""
        self.odometer.hear(driven)

    def predict(self, t_ns: int, imu: ImuBatch | None, dt_s: float) -> F64:
        """T_m_c of a frame: by an IMU that knows, else by an odometer that does, else by constant velocity."""
        if self.tracker is not None:
            self._news += self._watch.frame(t_ns, imu)
        known = None if self.tracker is None else self.tracker.predict(imu, t_ns)
        if known is not None:
            return se3.orthonormalise(known.T_m_b @ self._T_b_c)
        driven = self.odometer.predict(self._pose.T_m_c, t_ns)
        return self._pose.predict(dt_s) if driven is None else driven

    def fuse(self, track: Track, t_ns: int) -> Track:
        """The track with the pose that images and IMU together give."""
        state = None
        if self.tracker is not None:
            seen = VisualPoints(track.xyz, track.ray, track.observed, track.sigma_px, track.inlier)
            driven = self.odometer.velocity(t_ns)
            state = self.tracker.update(t_ns, se3.inverse(track.T_c_m) @ self._T_c_b, seen, driven)
        if state is not None:
            track = replace(track, T_c_m=se3.inverse(state.T_m_b @ self._T_b_c))
        self.odometer.seen(se3.inverse(track.T_c_m), t_ns)
        return track

    def news(self) -> list[str]:
        """What is worth an event since the last call."""
        news, self._news = self._news, []
        return news + self.odometer.news() + ([] if self.tracker is None else self.tracker.offset_news())

    def coast(self, predicted: F64, t_ns: int) -> Coasted:
        """A frame without images, predicted at T_m_c (4,4)."""
        state = None if self.tracker is None else self.tracker.coast(t_ns, self.odometer.velocity(t_ns))
        if self.tracker is None or state is None:
            cov = self.odometer.coasted(predicted, t_ns)
            trusted = self.odometer.sure and self.odometer.blind_s <= self._config.trusted_blind_s
            return Coasted(predicted, cov, trusted)
        self.odometer.coasted(state.T_m_b @ self._T_b_c, t_ns)
        trusted = self.tracker.blind_s <= self._config.trusted_blind_s
        return Coasted(state.T_m_b @ self._T_b_c, state.pose_cov, trusted)

    def restart(self, t_ns: int) -> None:
        """The pose was found again, or a new map began: the inertial state moves there."""
        if self.tracker is not None:
            self.tracker.begin_map(t_ns, self._pose.T_m_c @ self._T_c_b)
        self.odometer.restart(self._pose.T_m_c, t_ns)

    def shift(self, T_new_old: F64) -> None:
        """The submap frame moved by (4,4)."""
        if self.tracker is not None:
            self.tracker.shift_map(T_new_old)
        self.odometer.shift(T_new_old)

    def forget_unit(self) -> None:
        """A map in a unit of its own begins."""
        self.odometer.change_unit(metric=False)
        if self.tracker is not None:
            self.tracker.reset()
            self.tracker.metric = False

    def unit_m(self, sigma: float) -> float | None:
        """How many metres the map's unit is, once that is known to a relative deviation; None before, and where lengths
        are metres anyhow.
        """
        if self.metric:
            return None
        felt = None if self.tracker is None else self.tracker.metric_scale()
        driven = self.odometer.unit_m()
        known = [(scale, dev / scale) for scale, dev in filter(None, (felt, driven)) if dev <= sigma * scale]
        if not known or (driven is None and self.odometer.measures_unit):  # two witnesses are better than one
            return None
        weight = [1.0 / (dev * dev + self._config.unit_sigma**2) for _, dev in known]
        return sum(w * scale for w, (scale, _) in zip(weight, known, strict=True)) / sum(weight)

    def begin_metres(self, unit_m: float, T_new_old: F64) -> None:
        """From now on lengths are metres, in a submap in which the old one lies at (4,4)."""
        if self.tracker is not None:
            self.tracker.rescale(unit_m)
            self.tracker.shift_map(T_new_old)
        self.odometer.change_unit(metric=True)

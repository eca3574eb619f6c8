"""Velocities reported by a flight controller, as odometry samples in the body frame and on our clock. Pure.

MAVLink uses f = MAV_FRAME_BODY_FRD (x forward, y right, z down) and NED; kiteline's body may be mounted in any
orientation (`coordinate_frames.mounting`). The estimate of a controller that fuses our own poses only repeats them: it
is odometry only if it rests on other sensors (optical flow, GNSS, wheels), which the user has to know.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from kiteline_core import odometry
from kiteline_core.arrays import F64
from kiteline_core.frame import OdometryBatch
from kiteline_core.geometry import se3
from kiteline_hw.mavlink.messages import (
    Attitude,
    Heartbeat,
    LocalPosition,
    MavlinkMessage,
    MessageInterval,
    Odometry,
    WheelDistance,
)
from kiteline_hw.sensors.odometry_buffer import OdometerStream, reported_covariance

_BODY = (8, 12)  # MAV_FRAME_BODY_NED (as old senders call it) and MAV_FRAME_BODY_FRD: x forward, y right, z down
_LOCAL = (1, 20)  # MAV_FRAME_LOCAL_NED and MAV_FRAME_LOCAL_FRD: the attitude rotates f into them
_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1; messages of other components may be our own, sent back by a router


class OdometrySource(Enum):
    """What is used as odometry."""

    CONTROLLER = "controller"  # velocity and angular rate of the controller's filter
    WHEELS = "wheels"  # distances rolled by the wheels


_MESSAGE_IDS = {OdometrySource.CONTROLLER: (331, 32, 30), OdometrySource.WHEELS: (9000,)}


@dataclass(frozen=True, slots=True)
class ControllerOdometryConfig:
    """How messages become samples."""

    track_m: float = 0.0  # m between the first (left) and the second (right) wheel; 0: wheels measure no yaw rate
    velocity_sigma_m_s: float = 0.1  # of a filter that reports none; of rolled distances over one message
    rate_sigma_rad_s: float = 0.02  # likewise; a filter's rate is its gyro's
    across_sigma_m_s: float = 0.2  # of a wheeled vehicle's sideways and vertical velocity around 0
    tilt_sigma_rad_s: float = 0.3  # of its roll and pitch rates around 0
    attitude_ns: int = 100_000_000  # ns; an older attitude rotates no velocity: 6 degrees at 1 rad/s
    min_wheel_ns: int = 5_000_000  # ns; rolled distances are not differenced over less: counts are coarse
    max_wheel_ns: int = 500_000_000  # ns; nor over more
    drift: float = 2e-4  # s/s between the controller's clock and ours, at most
    reset_ns: int = 2_000_000_000  # ns; a stamp that goes back by more is of another boot
    late_ns: int = 1_000_000_000  # ns for which stamps stay behind by as much, until they are, too: a stall ends sooner
    interval_us: int = 20_000  # us between two messages, as requested
    request_ns: int = 2_000_000_000  # ns of silence after which they are requested again
    max_samples: int = 1024  # buffered until the next frame; 20 s at 50 Hz


class StampClock:
    """Converts a controller's stamps to our clock. Messages arrive late, never early: the least delay counts as 0."""

    def __init__(self, config: ControllerOdometryConfig | None = None) -> None:
        self._config = config or ControllerOdometryConfig()
        self._offset_ns: int | None = None  # our clock less theirs, at the least delay seen
        self._last: tuple[int, int] = (0, 0)  # stamp, arrival
        self._late_since_ns: int | None = None  # arrival of the first message in a row that seems seconds late

    def to_ours(self, stamp_ns: int, now_ns: int) -> int:
        """The time on our clock of a stamp that arrived now."""
        last_stamp_ns, last_arrival_ns = self._last
        self._last = stamp_ns, now_ns
        offset_ns = now_ns - stamp_ns
        if self._offset_ns is None or last_stamp_ns - stamp_ns > self._config.reset_ns or self._lags(offset_ns, now_ns):
            self._offset_ns = offset_ns
        drifted_ns = self._offset_ns + round(self._config.drift * (now_ns - last_arrival_ns))
        self._offset_ns = min(offset_ns, drifted_ns)
        return stamp_ns + self._offset_ns

    def _lags(self, offset_ns: int, now_ns: int) -> bool:
        """True if messages seem seconds late for long: another boot, whose clock has passed that of the last one."""
        if self._offset_ns is None or offset_ns - self._offset_ns <= self._config.reset_ns:
            self._late_since_ns = None
            return False
        if self._late_since_ns is None:
            self._late_since_ns = now_ns
        return now_ns - self._late_since_ns >= self._config.late_ns


def _is_finite(message: MavlinkMessage) -> bool:
    """False if a number of a message that is computed with is none, or infinite; `usable` refuses the others."""
    match message:
        case Odometry():
            rotated = message.child_frame_id in _LOCAL
            used: tuple[float, ...] = (*message.velocity_m_s, *message.q) if rotated else ()
        case Attitude():
            used = (*message.angles_rad, *message.rate_rad_s)
        case LocalPosition():
            used = tuple(message.velocity_m_s)
        case WheelDistance():
            used = message.distance_m
        case _:
            used = ()
    return all(map(math.isfinite, used))


class ControllerOdometry:
    """Converts messages to samples. T_b_f: (4,4) flight controller (FRD) in the body frame."""

    def __init__(self, source: OdometrySource, T_b_f: F64, config: ControllerOdometryConfig | None = None) -> None:
        self.config = config or ControllerOdometryConfig()
        self.source = source
        self.unusable = 0  # messages in frames that cannot be converted, or without finite values
        self._T_b_f = T_b_f
        self._us_clock, self._ms_clock = StampClock(self.config), StampClock(self.config)  # their origins may differ
        self._stream = OdometerStream()
        self._attitude: tuple[int, F64, F64] | None = None  # ms; R_n_f; rate
        self._last_wheels: WheelDistance | None = None
        self._has_odometry = False  # LOCAL_POSITION_NED would repeat the same velocity
        self._received_ns: int | None = None
        self._requested_ns: int | None = None
        self._handlers: dict[type[MavlinkMessage], Callable[[Any, int], OdometryBatch | None]] = (
            {WheelDistance: self._from_wheels}
            if source is OdometrySource.WHEELS
            else {Odometry: self._from_odometry, Attitude: self._keep_attitude, LocalPosition: self._from_position}
        )

    def requests(self, autopilot: Heartbeat, now_ns: int) -> list[MessageInterval]:
        """The requests for messages to send now; none while the messages come."""
        since_ns = max((t for t in (self._received_ns, self._requested_ns) if t is not None), default=None)
        if since_ns is not None and now_ns - since_ns < self.config.request_ns:
            return []
        self._requested_ns = now_ns
        target, interval_us = (autopilot.system, autopilot.component), self.config.interval_us
        return [MessageInterval(*target, i, interval_us) for i in _MESSAGE_IDS[self.source]]

    def receive(self, message: MavlinkMessage, now_ns: int) -> None:
        """Add a message; those of other kinds are ignored."""
        handler = self._handlers.get(type(message))
        if handler is not None and not _is_finite(message):
            self.unusable += 1
            return
        batch = handler(message, now_ns) if handler is not None else None
        if batch is not None:
            self._received_ns = now_ns
            if len(self._stream) < self.config.max_samples:
                self._stream.add(odometry.in_body(batch, self._T_b_f))

    def take_until(self, t_ns: int) -> OdometryBatch | None:
        """The samples up to a time on our clock, in the body frame."""
        return self._stream.take_until(t_ns)

    def _from_odometry(self, m: Odometry, now_ns: int) -> OdometryBatch | None:
        if m.component != _AUTOPILOT:
            return None
        velocity, rate = np.array(m.velocity_m_s, np.float64), np.array(m.rate_rad_s, np.float64)
        velocity_cov, rate_cov = self._covariances(m)
        if m.child_frame_id in _LOCAL:
            q = np.array(m.q, np.float64)
            r_f_l = se3.rotation_from_quaternion(q).T if q.any() else np.full((3, 3), np.nan)
            velocity, velocity_cov = r_f_l @ velocity, r_f_l @ velocity_cov @ r_f_l.T
        elif m.child_frame_id not in _BODY:
            self.unusable += 1
            return None
        self._has_odometry = True
        t_ns = self._us_clock.to_ours(m.time_usec * 1000, now_ns)
        return self._sample(t_ns, velocity, rate, velocity_cov, rate_cov)

    def _covariances(self, m: Odometry) -> tuple[F64, F64]:
        """Covariances of velocity and rate; defaults if the message has none, whose triangle then begins with NaN."""
        c = self.config
        triangle = np.array(m.velocity_covariance, np.float64)
        diagonal = np.full(6, np.nan)
        if len(triangle) == 21 and np.isfinite(triangle[0]):
            diagonal = triangle[[0, 6, 11, 15, 18, 20]]
        velocity_cov = reported_covariance(diagonal[:3], c.velocity_sigma_m_s)
        return velocity_cov, reported_covariance(diagonal[3:], c.rate_sigma_rad_s)

    def _keep_attitude(self, m: Attitude, now_ns: int) -> None:
        roll, pitch, yaw = (se3.so3_exp(angle * axis) for angle, axis in zip(m.angles_rad, np.eye(3), strict=True))
        self._attitude = m.t_ms, yaw @ pitch @ roll, np.array(m.rate_rad_s, np.float64)

    def _from_position(self, m: LocalPosition, now_ns: int) -> OdometryBatch | None:
        c = self.config
        if self._has_odometry or self._attitude is None:
            return None
        attitude_ms, r_n_f, rate = self._attitude
        if abs(m.t_ms - attitude_ms) * 1_000_000 > c.attitude_ns:
            return None
        t_ns = self._ms_clock.to_ours(m.t_ms * 1_000_000, now_ns)
        cov, rate_cov = c.velocity_sigma_m_s**2 * np.eye(3), c.rate_sigma_rad_s**2 * np.eye(3)
        return self._sample(t_ns, r_n_f.T @ np.array(m.velocity_m_s, np.float64), rate, cov, rate_cov)

    def _from_wheels(self, m: WheelDistance, now_ns: int) -> OdometryBatch | None:
        c, before = self.config, self._last_wheels
        t_ns = self._us_clock.to_ours(m.t_us * 1000, now_ns)
        span_ns = 0 if before is None else (m.t_us - before.t_us) * 1000
        if before is not None and 0 <= span_ns < c.min_wheel_ns:
            return None
        self._last_wheels = m
        n = len(m.distance_m)
        if before is None or not 0 < span_ns <= c.max_wheel_ns or n == 0 or len(before.distance_m) != n:
            return None
        speeds = (np.array(m.distance_m) - np.array(before.distance_m)) / (span_ns * 1e-9)
        velocity = np.array([float(speeds.mean()), 0.0, 0.0])
        velocity_cov = odometry.variances((c.velocity_sigma_m_s, c.across_sigma_m_s, c.across_sigma_m_s))
        rate, rate_cov = np.zeros(3), odometry.variances((c.tilt_sigma_rad_s, c.tilt_sigma_rad_s, np.inf))
        if c.track_m > 0.0 and n >= 2:
            rate[2] = (speeds[0] - speeds[1]) / c.track_m  # the left wheel is the faster one in a turn to the right
            rate_cov[2, 2] = 2.0 * (c.velocity_sigma_m_s / c.track_m) ** 2
        # A mean speed belongs to the middle of its interval.
        return self._sample(t_ns - span_ns // 2, velocity, rate, velocity_cov, rate_cov)

    def _sample(
        self, t_ns: int, velocity: F64, rate: F64, velocity_cov: F64, rate_cov: F64
    ) -> OdometryBatch | None:  # fmt: skip
        batch = OdometryBatch(
            np.array([t_ns], np.int64), velocity[None], rate[None], velocity_cov[None], rate_cov[None]
        )
        if not odometry.usable(batch).all():
            self.unusable += 1
            return None
        return batch


def parse_odometry_option(text: str) -> tuple[OdometrySource, float]:
    """The source, and the track in m, of `controller`, `wheels` or `wheels:TRACK_M`. Raises ValueError."""
    kind, colon, track = text.partition(":")
    message = f"odometry {text!r}: expected controller, wheels or wheels:TRACK_M, for instance wheels:0.4"
    try:
        source, track_m = OdometrySource(kind), float(track) if colon else 0.0
    except ValueError as error:
        raise ValueError(message) from error
    if not 0.0 <= track_m < 100.0 or (colon and source is not OdometrySource.WHEELS):
        raise ValueError(message)
    return source, track_m

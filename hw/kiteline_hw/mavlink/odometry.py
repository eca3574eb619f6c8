"""What a flight controller says of its velocity, as samples of an odometer in the body frame and on our clock. Pure.

MAVLink speaks of f = MAV_FRAME_BODY_FRD (x forward, y right, z down) and of NED; kiteline's body may lie anyhow in the
vehicle (`mavlink_frames.mounting`). A controller that fuses our own poses only tells us what we told it: its estimate
is an odometer where it rests on something else (optical flow, GNSS, wheels), which nobody but its owner knows.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from kiteline_core import odometry
from kiteline_core.frame import OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.se3 import F64
from kiteline_hw.mavlink.messages import Attitude, Incoming, LocalPosition, MavlinkCodec, Odometry, WheelDistance
from kiteline_hw.sensors.odometry_buffer import OdometerStream, stated_variances

_BODY = (8, 12)  # MAV_FRAME_BODY_NED (as old senders call it) and MAV_FRAME_BODY_FRD: x forward, y right, z down
_LOCAL = (1, 20)  # MAV_FRAME_LOCAL_NED and MAV_FRAME_LOCAL_FRD: the attitude turns f into them
_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1; what other components send may be our own poses, sent back by a router
_IDS = {"controller": (331, 32, 30), "wheels": (9000,)}


class Told(Enum):
    """What is taken from a flight controller."""

    CONTROLLER = "controller"  # velocity and turn rate of its filter
    WHEELS = "wheels"  # what its wheels have rolled


@dataclass(frozen=True, slots=True)
class FromControllerConfig:
    """How messages become samples."""

    track_m: float = 0.0  # m between the first (left) and the second (right) wheel; 0: wheels tell no turn
    velocity_sigma_m_s: float = 0.1  # of a filter that does not say; of rolled distances over one message
    rate_sigma_rad_s: float = 0.02  # likewise; a filter's rate is its gyro's
    across_sigma_m_s: float = 0.2  # that a vehicle on wheels slides sideways or is lifted
    tilt_sigma_rad_s: float = 0.3  # that it rolls and pitches
    attitude_ns: int = 100_000_000  # ns; an older attitude turns no velocity: 6 degrees at 1 rad/s
    shortest_ns: int = 5_000_000  # ns; rolled distances are not differenced across less: counts are coarse
    longest_ns: int = 500_000_000  # ns; nor across more
    drift: float = 2e-4  # s/s that the controller's clock may run apart from ours
    leap_ns: int = 2_000_000_000  # ns; a stamp that goes back by more is another boot
    interval_us: int = 20_000  # us between two messages that are asked for
    ask_ns: int = 2_000_000_000  # ns of silence after which they are asked for again
    most_samples: int = 1024  # that wait for a frame; 20 s at 50 Hz


class StampClock:
    """A controller's stamps on our clock: they arrive late, never early, so the least delay is the nearest to none."""

    def __init__(self, config: FromControllerConfig | None = None) -> None:
        self._config = config or FromControllerConfig()
        self._ahead_ns: int | None = None  # our clock less theirs, with the least delay seen
        self._last: tuple[int, int] = (0, 0)  # stamp, arrival

    def ours(self, stamp_ns: int, now_ns: int) -> int:
        """The instant of a stamp that arrived now."""
        before_ns, arrived_ns = self._last
        self._last = stamp_ns, now_ns
        ahead_ns = now_ns - stamp_ns
        if self._ahead_ns is None or before_ns - stamp_ns > self._config.leap_ns:
            self._ahead_ns = ahead_ns
        risen_ns = self._ahead_ns + round(self._config.drift * (now_ns - arrived_ns))
        self._ahead_ns = min(ahead_ns, risen_ns)
        return stamp_ns + self._ahead_ns


class FromController:
    """Messages in, samples out. T_b_f: (4,4) flight controller (FRD) in the body frame."""

    def __init__(self, told: Told, T_b_f: F64, config: FromControllerConfig | None = None) -> None:
        self.config = config or FromControllerConfig()
        self.told = told
        self.unusable = 0  # messages in frames that nobody can turn into ours, or that hold no numbers
        self._T_b_f = T_b_f
        self._clocks = {False: StampClock(self.config), True: StampClock(self.config)}  # us and ms stamps differ
        self._stream = OdometerStream()
        self._attitude: tuple[int, F64, F64] | None = None  # ms; R_n_f; rate
        self._rolled: WheelDistance | None = None
        self._has_odometry = False  # LOCAL_POSITION_NED would say the same again
        self._heard_ns: int | None = None
        self._asked_ns: int | None = None

    def questions(self, codec: MavlinkCodec, now_ns: int) -> list[bytes]:
        """What asks the flight controller for its messages, while they do not come."""
        since_ns = max((t for t in (self._heard_ns, self._asked_ns) if t is not None), default=None)
        if since_ns is not None and now_ns - since_ns < self.config.ask_ns:
            return []
        self._asked_ns = now_ns
        ids = _IDS[self.told.value]
        return [codec.message_interval(1, _AUTOPILOT, number, self.config.interval_us) for number in ids]

    def receive(self, message: Incoming, now_ns: int) -> None:
        """Take a message; those of no use here are passed over."""
        batch = None
        if self.told is Told.WHEELS:
            if isinstance(message, WheelDistance):
                batch = self._wheels(message, now_ns)
        elif isinstance(message, Odometry):
            batch = self._odometry(message, now_ns)
        elif isinstance(message, Attitude):
            self._note_attitude(message)
        elif isinstance(message, LocalPosition) and not self._has_odometry:
            batch = self._local(message, now_ns)
        if batch is not None:
            self._heard_ns = now_ns
            if len(self._stream) < self.config.most_samples:
                self._stream.add(odometry.in_body(batch, self._T_b_f))

    def take_until(self, t_ns: int) -> OdometryBatch | None:
        """The samples up to an instant of our clock, in the body frame."""
        return self._stream.take_until(t_ns)

    # by message

    def _odometry(self, m: Odometry, now_ns: int) -> OdometryBatch | None:
        if m.component != _AUTOPILOT:
            return None
        velocity, rate = np.array(m.velocity_m_s, np.float64), np.array(m.rate_rad_s, np.float64)
        velocity_cov, rate_cov = self._stated(m)
        if m.child_frame_id in _LOCAL:
            q = np.array(m.q, np.float64)
            r_f_l = se3.rotation_from_quaternion(q).T if q.any() else np.full((3, 3), np.nan)
            velocity, velocity_cov = r_f_l @ velocity, r_f_l @ velocity_cov @ r_f_l.T
        elif m.child_frame_id not in _BODY:
            self.unusable += 1
            return None
        self._has_odometry = True
        return self._sample(
            self._clocks[False].ours(m.time_usec * 1000, now_ns), velocity, rate, velocity_cov, rate_cov
        )

    def _stated(self, m: Odometry) -> tuple[F64, F64]:
        """Covariances of velocity and rate as the message says, where it says; its triangle has NaN first where not."""
        c = self.config
        triangle = np.array(m.velocity_covariance, np.float64)
        diagonal = np.full(6, np.nan)
        if len(triangle) == 21 and np.isfinite(triangle[0]):
            diagonal = triangle[[0, 6, 11, 15, 18, 20]]
        return (
            stated_variances(diagonal[:3], c.velocity_sigma_m_s),
            stated_variances(diagonal[3:], c.rate_sigma_rad_s),
        )

    def _note_attitude(self, m: Attitude) -> None:
        roll, pitch, yaw = (se3.so3_exp(angle * axis) for angle, axis in zip(m.angles_rad, np.eye(3), strict=True))
        self._attitude = m.t_ms, yaw @ pitch @ roll, np.array(m.rate_rad_s, np.float64)

    def _local(self, m: LocalPosition, now_ns: int) -> OdometryBatch | None:
        c = self.config
        if self._attitude is None or abs(m.t_ms - self._attitude[0]) * 1_000_000 > c.attitude_ns:
            return None
        _, r_n_f, rate = self._attitude
        t_ns = self._clocks[True].ours(m.t_ms * 1_000_000, now_ns)
        cov, rate_cov = c.velocity_sigma_m_s**2 * np.eye(3), c.rate_sigma_rad_s**2 * np.eye(3)
        return self._sample(t_ns, r_n_f.T @ np.array(m.velocity_m_s, np.float64), rate, cov, rate_cov)

    def _wheels(self, m: WheelDistance, now_ns: int) -> OdometryBatch | None:
        c, before = self.config, self._rolled
        t_ns = self._clocks[False].ours(m.t_us * 1000, now_ns)
        span_ns = 0 if before is None else (m.t_us - before.t_us) * 1000
        if before is not None and 0 <= span_ns < c.shortest_ns:
            return None
        self._rolled = m
        n = len(m.distance_m)
        if before is None or not 0 < span_ns <= c.longest_ns or n == 0 or len(before.distance_m) != n:
            return None
        speeds = (np.array(m.distance_m) - np.array(before.distance_m)) / (span_ns * 1e-9)
        velocity = np.array([float(speeds.mean()), 0.0, 0.0])
        velocity_cov = odometry.variances((c.velocity_sigma_m_s, c.across_sigma_m_s, c.across_sigma_m_s))
        rate, rate_cov = np.zeros(3), odometry.variances((c.tilt_sigma_rad_s, c.tilt_sigma_rad_s, np.inf))
        if c.track_m > 0.0 and n >= 2:
            rate[2] = (speeds[0] - speeds[1]) / c.track_m  # the left wheel is the faster one in a turn to the right
            rate_cov[2, 2] = 2.0 * (c.velocity_sigma_m_s / c.track_m) ** 2
        # a mean speed is that of the middle of its interval
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


def told_of(text: str) -> tuple[Told, float]:
    """What `controller`, `wheels` or `wheels:TRACK_M` asks for, and the track in m. Raises ValueError."""
    kind, colon, track = text.partition(":")
    try:
        told, track_m = Told(kind), float(track) if colon else 0.0
    except ValueError as error:
        raise ValueError(f"odometry {text!r}: expected controller, wheels or wheels:TRACK_M, for instance wheels:0.4"
                         ) from error  # fmt: skip
    if not 0.0 <= track_m < 100.0 or (colon and told is not Told.WHEELS):
        raise ValueError(f"odometry {text!r}: expected controller, wheels or wheels:TRACK_M, for instance wheels:0.4")
    return told, track_m

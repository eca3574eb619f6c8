"""What goes to a flight controller, and when: HEARTBEAT, ODOMETRY, answers to TIMESYNC. Time is handed in.

The controller gets the continuous odometry frame. Corrections of the map never reach it: they would be jumps.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_core.geometry.se3 import F64
from kiteline_hw.mavlink.frames import body_rates, controller_covariance, local_covariance, local_pose, upper_triangle
from kiteline_hw.mavlink.imu import ControllerImu
from kiteline_hw.mavlink.messages import Heartbeat, MavlinkCodec, Odometry, TimeSync, VehicleImu
from kiteline_hw.mavlink.odometry import FromController
from kiteline_hw.ports import PoseSample

_FARTHEST_M = 1e6  # m; beyond it something is broken, and a float32 has lost its centimetres


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """How poses are sent."""

    rate_hz: float = 30.0  # Hz; PX4 wants 30 to 50, ArduPilot at least 4; 245 bytes each
    rate_slack_ns: int = 4_000_000  # ns; a frame that comes this early is not late for its turn: cameras jitter
    heartbeat_ns: int = 1_000_000_000  # ns; the MAVLink routine
    longest_gap_ns: int = 250_000_000  # ns; velocities are not taken across a longer gap between poses
    shortest_gap_ns: int = 20_000_000  # ns; nor across a shorter one: noise over time
    floor_m: float = 0.01  # m; added to a pose's own deviation: 5 ms of delay at 2 m/s, and how it is mounted
    floor_rad: float = 0.005  # rad; likewise
    position_sigma_m: float = (
        0.03  # m; of a good pose without a covariance. Both controllers read the diagonal as noise
    )
    angle_sigma_rad: float = 0.02  # rad; likewise
    velocity_sigma_m_s: float = 0.1  # m/s; of two poses a frame apart
    rate_sigma_rad_s: float = 0.1  # rad/s; likewise


@dataclass(slots=True)
class OdometryCounters:
    """What was sent and why poses were not."""

    odometry: int = 0
    heartbeats: int = 0
    timesync_answers: int = 0
    rate_limited: int = 0
    without_velocity: int = 0  # the first of a row: there is nothing to take a velocity from
    broken: int = 0  # not finite, or absurdly far away
    stale: int = 0  # not newer than the one before


class OdometryStream:
    """Poses in, MAVLink bytes out. T_b_f: (4,4) flight controller (FRD) in the body frame: mavlink_frames.mounting."""

    def __init__(
        self, T_b_f: F64, config: OdometryConfig | None = None, codec: MavlinkCodec | None = None,
        wanted: FromController | None = None, imu: ControllerImu | None = None,
    ) -> None:  # fmt: skip
        """wanted: takes what the controller says of its own velocity, imu: what its inertial unit feels; None: nobody
        asks.
        """
        self.config = config or OdometryConfig()
        self.codec = codec or MavlinkCodec()
        self.counters = OdometryCounters()
        self._T_b_f = T_b_f
        self._period_ns = round(1e9 / self.config.rate_hz)
        self._next_heartbeat_ns: int | None = None
        self._next_odometry_ns: int | None = None
        self._past: deque[PoseSample] = deque()
        self._autopilot: tuple[Heartbeat, int] | None = None
        self._wanted = wanted
        self._imu = imu

    def step(self, pose: PoseSample | None, now_ns: int) -> list[bytes]:
        """Messages to send now: a heartbeat if it is time, the pose (the newest, or None) if it is its turn."""
        out = []
        if self._next_heartbeat_ns is None or now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + self.config.heartbeat_ns
            self.counters.heartbeats += 1
            out.append(self.codec.heartbeat())
        if pose is not None:
            message = self._odometry(pose, now_ns)
            if message is not None:
                self.counters.odometry += 1
                out.append(self.codec.odometry(message))
        return out

    def _odometry(self, pose: PoseSample, now_ns: int) -> Odometry | None:
        if not np.all(np.isfinite(pose.T_o_b)) or float(np.abs(pose.T_o_b[:3, 3]).max()) > _FARTHEST_M:
            self.counters.broken += 1
            return None
        if self._past and self._past[-1].epoch != pose.epoch:
            self._past.clear()
        if self._past and pose.t_ns <= self._past[-1].t_ns:
            self.counters.stale += 1
            return None
        before = self._earlier(pose.t_ns)
        self._past.append(pose)
        if before is None:
            self.counters.without_velocity += 1  # ArduPilot would take NaN velocities into its filter
            return None
        if not self._is_turn(now_ns):
            self.counters.rate_limited += 1
            return None
        dt_s = (pose.t_ns - before.t_ns) * 1e-9
        velocity, rate = body_rates(before.T_o_b, pose.T_o_b, dt_s, self._T_b_f)
        position, q = local_pose(pose.T_o_b, self._T_b_f)
        quality = max(-1, min(100, pose.quality)) if pose.tracked else -1
        pose_cov, velocity_cov = self._covariances(pose, quality)
        return Odometry(
            time_usec=pose.t_ns // 1000,
            position_m=position.tolist(),
            q=q.tolist(),
            velocity_m_s=velocity.tolist(),
            rate_rad_s=rate.tolist(),
            pose_covariance=pose_cov,
            velocity_covariance=velocity_cov,
            reset_counter=pose.epoch & 0xFF,
            quality=quality,
        )

    def _earlier(self, t_ns: int) -> PoseSample | None:
        """The newest pose that is far enough back to take a velocity from. Forgets those too far back."""
        while self._past and t_ns - self._past[0].t_ns > self.config.longest_gap_ns:
            self._past.popleft()
        return next((p for p in reversed(self._past) if t_ns - p.t_ns >= self.config.shortest_gap_ns), None)

    def _is_turn(self, now_ns: int) -> bool:
        """Whether the rate allows a message now. Early turns are paid back, so that the mean rate holds."""
        due_ns = self._next_odometry_ns
        if due_ns is None or now_ns - due_ns >= self._period_ns:
            self._next_odometry_ns = now_ns + self._period_ns
            return True
        if now_ns + self.config.rate_slack_ns < due_ns:
            return False
        self._next_odometry_ns = due_ns + self._period_ns
        return True

    def _covariances(self, pose: PoseSample, quality: int) -> tuple[list[float], list[float]]:
        """Of the pose: its own, on top of a floor; where it has none, and of velocities: diagonal ones that grow as the
        quality falls, tenfold in standard deviation where it failed.
        """
        c = self.config
        worse = 100.0 / max(10, quality)
        sigma = worse * np.array([c.position_sigma_m] * 3 + [c.angle_sigma_rad] * 3)
        sigma_v = worse * np.array([c.velocity_sigma_m_s] * 3 + [c.rate_sigma_rad_s] * 3)
        if pose.cov is None:
            of_pose = local_covariance(np.diag(sigma**2))
        else:
            floor = np.diag(np.repeat([c.floor_m, c.floor_rad], 3) ** 2)
            of_pose = controller_covariance(pose.cov, pose.T_o_b, self._T_b_f) + floor
        return upper_triangle(of_pose), upper_triangle(np.diag(sigma_v**2))

    def receive(self, data: bytes, now_ns: int, *, datagram: bool = False) -> list[bytes]:
        """Take what came from the flight controller, any bytes; the answers to send at once."""
        out = []
        for message in self.codec.receive(data, datagram=datagram):
            if isinstance(message, TimeSync):
                if message.tc1_ns == 0:
                    self.counters.timesync_answers += 1
                    out.append(self.codec.timesync(now_ns, message.ts1_ns))
            elif isinstance(message, Heartbeat):
                if message.is_autopilot:
                    self._autopilot = message, now_ns
                    out += [] if self._wanted is None else self._wanted.questions(self.codec, now_ns)
                    out += [] if self._imu is None else self._imu.questions(self.codec, message, now_ns)
            elif isinstance(message, VehicleImu):
                if self._imu is not None:
                    self._imu.receive(message, None if self._autopilot is None else self._autopilot[0], now_ns)
            elif self._wanted is not None:
                self._wanted.receive(message, now_ns)
        return out

    def autopilot(self, now_ns: int) -> Heartbeat | None:
        """The flight controller at the other end, or None when it has been silent for three heartbeats."""
        if self._autopilot is None or now_ns - self._autopilot[1] > 3 * self.config.heartbeat_ns:
            return None
        return self._autopilot[0]

    def take_odometry(self, t_ns: int) -> OdometryBatch | None:
        """What the controller said of its velocity up to an instant, in the body frame; None where nobody asked."""
        return None if self._wanted is None else self._wanted.take_until(t_ns)

    def take_imu(self, t_ns: int) -> ImuBatch | None:
        """The controller's inertial samples up to an instant, in the body frame; None where nobody asked."""
        return None if self._imu is None else self._imu.take_until(t_ns)

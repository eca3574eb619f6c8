"""The protocol with a flight controller: sends HEARTBEAT, ODOMETRY and TIMESYNC answers. Pure; time is handed in.

Poses are sent in the continuous odometry frame. Map corrections are not sent, because the controller would see jumps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_core.geometry.se3 import F64
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.controller_odometry import ControllerOdometry
from kiteline_hw.mavlink.coordinate_frames import (
    body_rates,
    controller_covariance,
    controller_rates,
    local_covariance,
    local_pose,
    upper_triangle,
)
from kiteline_hw.mavlink.messages import Heartbeat, MavlinkMessage, Odometry, TimeSync, VehicleImu
from kiteline_hw.mavlink.watch.controller_watch import ControllerWatch
from kiteline_hw.mavlink.watch.presence import LinkState
from kiteline_hw.ports import PoseSample

_MAX_POSITION_M = 1e6  # m; beyond it the estimate has failed, and a float32 cannot hold centimetres


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """How poses are sent."""

    rate_hz: float = 30.0  # Hz; PX4 wants 30 to 50, ArduPilot at least 4; 245 bytes each
    rate_slack_ns: int = 4_000_000  # ns; a frame may be sent this much before it is due: cameras jitter
    heartbeat_ns: int = 1_000_000_000  # ns; as MAVLink prescribes
    watch_ns: int = 100_000_000  # ns between two looks at what has changed
    max_gap_ns: int = 250_000_000  # ns; velocities are not differenced over a longer gap between poses
    min_gap_ns: int = 20_000_000  # ns; nor over a shorter one, in which noise dominates
    floor_m: float = 0.01  # m; added to a pose's own deviation: 5 ms of delay at 2 m/s, and mounting errors
    floor_rad: float = 0.005  # rad; likewise
    position_sigma_m: float = 0.03  # m; of a good pose without covariance; controllers read the diagonal as noise
    angle_sigma_rad: float = 0.02  # rad; likewise
    velocity_sigma_m_s: float = 0.1  # m/s; of two poses a frame apart
    rate_sigma_rad_s: float = 0.1  # rad/s; likewise


@dataclass(slots=True)
class OdometryCounters:
    """Messages sent, and poses that were not sent, by reason."""

    odometry: int = 0
    heartbeats: int = 0
    timesync_answers: int = 0
    rate_limited: int = 0
    without_velocity: int = 0  # no earlier pose to take a velocity from
    invalid: int = 0  # not finite, or absurdly far away
    stale: int = 0  # not newer than the one before


class ControllerSession:
    """Poses in, MAVLink bytes out. T_b_f: (4,4) flight controller (FRD) in the body: coordinate_frames.mounting.

    odometry, imu: receive the controller's velocities and inertial samples; None: they are not requested. watch: says
    what is found about the controller.
    """

    def __init__(
        self, T_b_f: F64, config: OdometryConfig | None = None, codec: MavlinkCodec | None = None,
        odometry: ControllerOdometry | None = None, imu: ControllerImu | None = None,
        watch: ControllerWatch | None = None,
    ) -> None:  # fmt: skip
        self.config = config or OdometryConfig()
        self.codec = codec or MavlinkCodec()
        self.counters = OdometryCounters()
        self._T_b_f = T_b_f
        self._period_ns = round(1e9 / self.config.rate_hz)
        self._next_heartbeat_ns: int | None = None
        self._next_odometry_ns: int | None = None
        self._past: deque[PoseSample] = deque()
        self._autopilot: tuple[Heartbeat, int] | None = None
        self._odometry = odometry
        self._imu = imu
        self._watch = watch
        self._next_watch_ns: int | None = None
        self._received = self._messages = 0
        self._handlers: dict[type[MavlinkMessage], Callable[[Any, int], Sequence[MavlinkMessage]]] = {
            TimeSync: self._on_timesync,
            Heartbeat: self._on_heartbeat,
            VehicleImu: self._on_imu,
        }

    def step(self, pose: PoseSample | None, now_ns: int) -> list[bytes]:
        """The frames to send now: a heartbeat if it is due, and the newest pose (or None) if the rate allows it."""
        out = []
        if self._next_heartbeat_ns is None or now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + self.config.heartbeat_ns
            self.counters.heartbeats += 1
            out.append(self.codec.encode(Heartbeat()))
        if pose is not None:
            message = self._pose_message(pose, now_ns)
            if message is not None:
                self.counters.odometry += 1
                out.append(self.codec.encode(message))
                if self._watch is not None:
                    self._watch.sent(pose, message.quality, now_ns)
        return out

    def watch(self, now_ns: int, device_fault: str = "") -> list[bytes]:
        """The frames that the watch sends now. device_fault: why the serial port is not open."""
        if self._watch is None or (self._next_watch_ns is not None and now_ns < self._next_watch_ns):
            return []
        self._next_watch_ns = now_ns + self.config.watch_ns
        codec = self.codec
        link = LinkState(
            self._received, self._messages, codec.signed, codec.refused, has_key=False, device_fault=device_fault
        )
        return [codec.encode(message) for message in self._watch.tick(now_ns, link)]

    def _pose_message(self, pose: PoseSample, now_ns: int) -> Odometry | None:
        if not np.all(np.isfinite(pose.T_o_b)) or float(np.abs(pose.T_o_b[:3, 3]).max()) > _MAX_POSITION_M:
            self.counters.invalid += 1
            return None
        if self._past and self._past[-1].epoch != pose.epoch:
            self._past.clear()
        if self._past and pose.t_ns <= self._past[-1].t_ns:
            self.counters.stale += 1
            return None
        before = self._earlier_pose(pose.t_ns)
        self._past.append(pose)
        if before is None and pose.velocity is None:
            self.counters.without_velocity += 1  # ArduPilot would take NaN velocities into its filter
            return None
        if not self._is_due(now_ns):
            self.counters.rate_limited += 1
            return None
        velocity, rate = self._rates(before, pose)
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

    def _rates(self, before: PoseSample | None, pose: PoseSample) -> tuple[F64, F64]:
        """Velocity and angular rate (3,) in f: the pose's own, else between two poses, as of half-way between them."""
        if pose.velocity is not None and pose.rate is not None:
            return controller_rates(pose.T_o_b, pose.velocity, pose.rate, self._T_b_f)
        assert before is not None
        return body_rates(before.T_o_b, pose.T_o_b, (pose.t_ns - before.t_ns) * 1e-9, self._T_b_f)

    def _earlier_pose(self, t_ns: int) -> PoseSample | None:
        """The newest pose old enough to take a velocity from, or None. Drops poses that are too old."""
        while self._past and t_ns - self._past[0].t_ns > self.config.max_gap_ns:
            self._past.popleft()
        return next((p for p in reversed(self._past) if t_ns - p.t_ns >= self.config.min_gap_ns), None)

    def _is_due(self, now_ns: int) -> bool:
        """True if the rate allows a message now. An early message delays the next one: the mean rate holds."""
        due_ns = self._next_odometry_ns
        if due_ns is None or now_ns - due_ns >= self._period_ns:
            self._next_odometry_ns = now_ns + self._period_ns
            return True
        if now_ns + self.config.rate_slack_ns < due_ns:
            return False
        self._next_odometry_ns = due_ns + self._period_ns
        return True

    def _covariances(self, pose: PoseSample, quality: int) -> tuple[list[float], list[float]]:
        """Covariances of pose and velocity. The pose's own plus a floor if it has one.

        Else, and for velocities, diagonal ones that grow as the quality falls: tenfold in standard deviation when
        tracking failed.
        """
        c = self.config
        factor = 100.0 / max(10, quality)
        sigma = factor * np.array([c.position_sigma_m] * 3 + [c.angle_sigma_rad] * 3)
        sigma_v = factor * np.array([c.velocity_sigma_m_s] * 3 + [c.rate_sigma_rad_s] * 3)
        if pose.cov is None:
            pose_cov = local_covariance(np.diag(sigma**2))
        else:
            floor = np.diag(np.repeat([c.floor_m, c.floor_rad], 3) ** 2)
            pose_cov = controller_covariance(pose.cov, pose.T_o_b, self._T_b_f) + floor
        return upper_triangle(pose_cov), upper_triangle(np.diag(sigma_v**2))

    def receive(self, data: bytes, now_ns: int, *, datagram: bool = False) -> list[bytes]:
        """Process bytes from the flight controller, in any pieces; the answers to send at once."""
        out: list[bytes] = []
        self._received += bool(data)
        for message in self.codec.receive(data, datagram=datagram):
            self._messages += 1
            if self._watch is not None:
                self._watch.receive(message, now_ns)
            handler = self._handlers.get(type(message))
            if handler is not None:
                out += [self.codec.encode(answer) for answer in handler(message, now_ns)]
            elif self._odometry is not None:
                self._odometry.receive(message, now_ns)
        return out

    def _on_timesync(self, m: TimeSync, now_ns: int) -> Sequence[MavlinkMessage]:
        if m.tc1_ns != 0:
            return ()
        self.counters.timesync_answers += 1
        return (TimeSync(now_ns, m.ts1_ns),)

    def _on_heartbeat(self, m: Heartbeat, now_ns: int) -> Sequence[MavlinkMessage]:
        if not m.is_autopilot:
            return ()
        self._autopilot = m, now_ns
        velocities = [] if self._odometry is None else self._odometry.requests(now_ns)
        return velocities + ([] if self._imu is None else self._imu.requests(m, now_ns))

    def _on_imu(self, m: VehicleImu, now_ns: int) -> Sequence[MavlinkMessage]:
        if self._imu is not None:
            self._imu.receive(m, None if self._autopilot is None else self._autopilot[0], now_ns)
        return ()

    def autopilot(self, now_ns: int) -> Heartbeat | None:
        """The connected flight controller, or None if it has been silent for three heartbeats."""
        if self._autopilot is None or now_ns - self._autopilot[1] > 3 * self.config.heartbeat_ns:
            return None
        return self._autopilot[0]

    def take_odometry(self, t_ns: int) -> OdometryBatch | None:
        """The controller's velocities up to a time, in the body frame; None if there are none."""
        return None if self._odometry is None else self._odometry.take_until(t_ns)

    def take_imu(self, t_ns: int) -> ImuBatch | None:
        """The controller's inertial samples up to a time, in the body frame; None if there are none."""
        return None if self._imu is None else self._imu.take_until(t_ns)

"""The protocol with a flight controller: sends HEARTBEAT, poses, TIMESYNC answers and findings. Pure, without a clock.

Poses are sent in the continuous odometry frame, turned once (`start_frame`). Map corrections are not sent, because the
controller would see jumps. One system is served: the configured one, else that of the first autopilot found.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_core.geometry.end_rates import end_rates
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.controller_odometry import ControllerOdometry
from kiteline_hw.mavlink.coordinate_frames import (
    controller_covariance,
    controller_rates,
    euler_angles,
    local_covariance,
    local_pose,
    rotated,
    upper_triangle,
)
from kiteline_hw.mavlink.messages import (
    Attitude,
    GlobalOrigin,
    Heartbeat,
    LocalPosition,
    MavlinkMessage,
    Odometry,
    SetGlobalOrigin,
    TimeSync,
    VehicleImu,
    VisionPosition,
    VisionSpeed,
)
from kiteline_hw.mavlink.start_frame import LastPose, StartFrame, last_pose
from kiteline_hw.mavlink.watch.controller_watch import ControllerWatch
from kiteline_hw.mavlink.watch.presence import LinkState
from kiteline_hw.ports import PoseSample

_ORIGIN_NS = 5_000_000_000  # ns between two requests for an origin
_MAX_POSITION_M = 1e6  # m; beyond it the estimate has failed, and a float32 cannot hold centimetres


@dataclass(frozen=True, slots=True)
class SessionConfig:
    """How often messages are sent, and with which covariances."""

    rate_hz: float = 30.0  # Hz; PX4 wants 30 to 50, ArduPilot at least 4; 245 bytes each
    rate_slack_ns: int = 4_000_000  # ns; a frame may be sent this much before it is due: cameras jitter
    heartbeat_ns: int = 1_000_000_000  # ns; as MAVLink prescribes
    watch_ns: int = 100_000_000  # ns between two looks at what has changed
    max_gap_ns: int = 250_000_000  # ns; older poses do not count for a velocity
    min_gap_ns: int = 20_000_000  # ns; least span of the poses that give one: in a shorter one noise dominates
    floor_m: float = 0.01  # m; added to a pose's own deviation: 5 ms of delay at 2 m/s, and mounting errors
    floor_rad: float = 0.005  # rad; likewise
    position_sigma_m: float = 0.03  # m; of a good pose without covariance; controllers read the diagonal as noise
    angle_sigma_rad: float = 0.02  # rad; likewise
    velocity_sigma_m_s: float = 0.1  # m/s; of two poses a frame apart
    rate_sigma_rad_s: float = 0.1  # rad/s; likewise
    vision: bool = False  # VISION_POSITION_ESTIMATE and VISION_SPEED_ESTIMATE in place of ODOMETRY
    origin: GlobalOrigin | None = None  # of the local frame, for a controller without GPS; None: none is set


@dataclass(slots=True)
class SessionCounters:
    """Messages sent, and poses that were not sent, by reason."""

    odometry: int = 0
    timesync_answers: int = 0
    without_velocity: int = 0  # no earlier pose to take a velocity from
    invalid: int = 0  # not finite, or absurdly far away
    stale: int = 0  # not newer than the one before
    held: int = 0  # before the heading was known, or because the axes are wrong
    other_autopilots: int = 0  # heartbeats of autopilots of other systems


class ControllerSession:
    """Poses in, MAVLink bytes out. T_b_f: (4,4) flight controller (FRD) in the body: coordinate_frames.mounting.

    odometry, imu: receive the controller's velocities and inertial samples; None: they are not requested. start:
    chooses the frame of the poses; None: they are sent as they come. watch: says what is found about the controller.
    system: of the vehicle; None: it is learnt.
    """

    def __init__(
        self, T_b_f: F64, config: SessionConfig | None = None, codec: MavlinkCodec | None = None,
        odometry: ControllerOdometry | None = None, imu: ControllerImu | None = None, start: StartFrame | None = None,
        watch: ControllerWatch | None = None, system: int | None = None,
    ) -> None:  # fmt: skip
        self.config = config or SessionConfig()
        self.codec = codec or MavlinkCodec()
        self.codec.only_system = system or 0
        if system is not None:
            self.codec.system = system
        self.counters = SessionCounters()
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
        self._start = start
        self._last: LastPose | None = None
        self._axes_hold = False
        self._origin_due_ns: int | None = None if self.config.origin is None else 0
        self._handlers: dict[type[MavlinkMessage], list[Callable[[Any, int], Sequence[MavlinkMessage]]]] = {}
        self.listen(TimeSync, self._on_timesync)
        self.listen(Heartbeat, self._on_heartbeat)
        self.listen(VehicleImu, self._on_imu)
        self.listen(GlobalOrigin, self._on_origin)
        if start is not None:
            self.listen(Attitude, start.on_attitude)
            self.listen(LocalPosition, start.on_position)

    def listen(
        self, kind: type[MavlinkMessage], handler: Callable[[Any, int], Sequence[MavlinkMessage]]
    ) -> None:  # fmt: skip
        """Call a handler with each message of a kind, and when it came; it returns the answers."""
        self._handlers.setdefault(kind, []).append(handler)

    def step(self, pose: PoseSample | None, now_ns: int) -> list[bytes]:
        """The frames to send now: a heartbeat if it is due, and the newest pose (or None) if the rate allows it."""
        out = []
        if self._next_heartbeat_ns is None or now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + self.config.heartbeat_ns
            out.append(self.codec.encode(Heartbeat()))
        if pose is not None:
            message = None if self._is_held(pose) else self._pose_message(pose, now_ns)
            if message is not None:
                self.counters.odometry += 1
                out += [self.codec.encode(m) for m in (self._vision(message) if self.config.vision else (message,))]
                if self._watch is not None:
                    self._watch.sent(pose, message.quality, now_ns)
        return out

    def _is_held(self, pose: PoseSample) -> bool:
        """True if the axes were found wrong on the ground: no such pose may arm the vehicle, or begin in flight."""
        watch = self._watch
        if watch is None:
            return False
        armed = self._autopilot is not None and self._autopilot[0].armed
        if watch.axes_are_wrong:
            self._axes_hold |= not armed
        elif watch.axes_fit:  # not if nothing is known of them: the controller may have restarted
            self._axes_hold = False
        watch.report_axes(held=self._axes_hold)
        if self._axes_hold:
            self.counters.held += 1
            watch.compare(pose)
        return self._axes_hold

    def watch(self, now_ns: int, device_fault: str = "") -> list[bytes]:
        """The frames that the watch sends now. device_fault: why the serial port is not open."""
        if self._watch is None or (self._next_watch_ns is not None and now_ns < self._next_watch_ns):
            return []
        self._next_watch_ns = now_ns + self.config.watch_ns
        if self._start is not None:
            self._watch.report_heading(held=self._start.holds(now_ns))
        codec = self.codec
        link = LinkState(
            self._received,
            self._messages,
            codec.signed,
            codec.refused,
            has_key=codec.has_key,
            device_fault=device_fault,
        )
        return [codec.encode(message) for message in self._watch.tick(now_ns, link)]

    def _pose_message(self, pose: PoseSample, now_ns: int) -> Odometry | None:
        framed = pose if self._start is None else self._start.in_frame(pose, now_ns)
        if framed is None:
            self.counters.held += 1
            return None
        pose = framed
        if not np.all(np.isfinite(pose.T_o_b)) or float(np.abs(pose.T_o_b[:3, 3]).max()) > _MAX_POSITION_M:
            self.counters.invalid += 1
            return None
        if self._past and self._past[-1].epoch != pose.epoch:
            self._past.clear()
        if self._past and pose.t_ns <= self._past[-1].t_ns:
            self.counters.stale += 1
            return None
        if pose.tracked and self._past and not self._past[-1].tracked:  # what was guessed tells no velocity
            self._past = deque(p for p in self._past if p.tracked)
        has_earlier = self._has_earlier_pose(pose.t_ns)
        self._past.append(pose)
        if not has_earlier and pose.velocity is None:
            self.counters.without_velocity += 1  # ArduPilot would take NaN velocities into its filter
            return None
        if not self._is_due(now_ns):
            return None
        velocity, rate = self._rates(pose)
        armed = self._autopilot is not None and self._autopilot[0].armed
        self._last = last_pose(pose.T_o_b @ self._T_b_f, armed=armed)
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

    def _vision(self, m: Odometry) -> Sequence[MavlinkMessage]:
        """The pose in the older messages, which have no quality: a failed one is not sent."""
        if m.quality < 0:
            return ()
        velocity, sigma = rotated(m.q, m.velocity_m_s), m.velocity_covariance[0]
        covariance = [sigma, 0.0, 0.0, 0.0, sigma, 0.0, 0.0, 0.0, sigma]
        return (
            VisionPosition(m.time_usec, m.position_m, euler_angles(m.q), m.pose_covariance, m.reset_counter),
            VisionSpeed(m.time_usec, velocity, covariance, m.reset_counter),
        )

    def _rates(self, pose: PoseSample) -> tuple[F64, F64]:
        """Velocity and angular rate (3,) in f at the time of the pose: its own, else by the poses up to it."""
        velocity, rate = pose.velocity, pose.rate
        if velocity is None or rate is None:
            velocity, rate = end_rates([p.t_ns for p in self._past], [p.T_o_b for p in self._past], pose.t_ns)
        return controller_rates(pose.T_o_b, velocity, rate, self._T_b_f)

    def _has_earlier_pose(self, t_ns: int) -> bool:
        """True if a pose is old enough to take a velocity from. Drops poses that are too old."""
        while self._past and t_ns - self._past[0].t_ns > self.config.max_gap_ns:
            self._past.popleft()
        return bool(self._past) and t_ns - self._past[0].t_ns >= self.config.min_gap_ns

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

    def receive(
        self, data: bytes, now_ns: int, *, datagram: bool = False, adopt: Callable[[], None] | None = None
    ) -> list[bytes]:
        """Process bytes from the flight controller, in any pieces; the answers to send at once.

        adopt: serves the sender from now on; None: it is served already. A sender is adopted when an autopilot of the
        vehicle speaks; before that its messages are ignored.
        """
        messages = self.codec.receive(data, datagram=datagram)
        if adopt is not None:
            if not any(isinstance(m, Heartbeat) and self._is_vehicle(m) for m in messages):
                return []
            adopt()
        out: list[bytes] = []
        self._received += bool(data)
        for message in messages:
            self._messages += 1
            if self._watch is not None and not self._is_other_vehicle(message):
                self._watch.receive(message, now_ns)
            for handler in self._handlers.get(type(message), ()):
                out += [self.codec.encode(answer) for answer in handler(message, now_ns)]
            if self._odometry is not None:
                self._odometry.receive(message, now_ns)
        return out

    def _is_other_vehicle(self, m: MavlinkMessage) -> bool:
        return isinstance(m, Heartbeat) and m.is_autopilot and not self._is_vehicle(m)

    def _is_vehicle(self, m: Heartbeat) -> bool:
        return m.is_autopilot and self.codec.only_system in (0, m.system)

    def _on_timesync(self, m: TimeSync, now_ns: int) -> Sequence[MavlinkMessage]:
        if m.tc1_ns != 0:
            return ()
        self.counters.timesync_answers += 1
        return (TimeSync(now_ns, m.ts1_ns),)

    def _on_heartbeat(self, m: Heartbeat, now_ns: int) -> Sequence[MavlinkMessage]:
        if not self._is_vehicle(m):
            self.counters.other_autopilots += m.is_autopilot
            return ()
        self.codec.only_system = self.codec.system = m.system
        self._autopilot = m, now_ns
        out: list[MavlinkMessage] = []
        if self._odometry is not None:
            out += self._odometry.requests(m, now_ns)
        if self._imu is not None:
            out += self._imu.requests(m, now_ns)
        if self._start is not None and not (self._start.known and self._odometry is not None):
            out += self._start.requests(m, now_ns)
        due_ns, origin = self._origin_due_ns, self.config.origin
        if origin is not None and due_ns is not None and now_ns >= due_ns and not m.armed:
            self._origin_due_ns = now_ns + _ORIGIN_NS
            out.append(SetGlobalOrigin(m.system, origin))
        return out

    def _on_origin(self, m: GlobalOrigin, now_ns: int) -> Sequence[MavlinkMessage]:
        self._origin_due_ns = None  # it has one: ours, or that of its GPS
        return ()

    def _on_imu(self, m: VehicleImu, now_ns: int) -> Sequence[MavlinkMessage]:
        if self._imu is not None:
            self._imu.receive(m, None if self._autopilot is None else self._autopilot[0], now_ns)
        return ()

    def autopilot(self, now_ns: int) -> Heartbeat | None:
        """The connected flight controller, or None if it has been silent for three heartbeats."""
        if self._autopilot is None or now_ns - self._autopilot[1] > 3 * self.config.heartbeat_ns:
            return None
        return self._autopilot[0]

    def last_pose(self) -> LastPose | None:
        """What an agent after this one has to know; None before the first pose."""
        return self._last

    def take_odometry(self, t_ns: int) -> OdometryBatch | None:
        """The controller's velocities up to a time, in the body frame; None if there are none."""
        return None if self._odometry is None else self._odometry.take_until(t_ns)

    def take_imu(self, t_ns: int) -> ImuBatch | None:
        """The controller's inertial samples up to a time, in the body frame; None if there are none."""
        return None if self._imu is None else self._imu.take_until(t_ns)

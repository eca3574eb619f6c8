"""The few MAVLink 2 messages that kiteline speaks, over the codec class of the generated dialect alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common

COMPONENT_VIO = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
_MARKERS = (0xFD, 0xFE)  # first byte of a frame of MAVLink 2 and 1
_SHORTEST = 8  # bytes of the shortest frame: what pymavlink starts with
HIGHRES_IMU, RAW_IMU, SCALED_IMU = 105, 27, 26  # message numbers
_ACCEL_AND_GYRO = 0x3F  # of HIGHRES_IMU's fields_updated
_MG = 9.80665e-3  # m/s^2 of a thousandth of standard gravity
_KEEP_BYTES = 4096  # bytes already parsed that pymavlink's buffer may hold before it is trimmed


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Somebody is there. armed: safety off."""

    system: int
    component: int
    type: int
    autopilot: int
    armed: bool

    @property
    def is_autopilot(self) -> bool:
        """A flight controller, not a companion, camera or ground station."""
        return self.component == 1 and self.autopilot != int(common.MAV_AUTOPILOT_INVALID)


@dataclass(frozen=True, slots=True)
class TimeSync:
    """tc1_ns == 0: a question, stamped ts1_ns by the asker; else its answer."""

    system: int
    component: int
    tc1_ns: int
    ts1_ns: int


@dataclass(frozen=True, slots=True)
class VehicleImu:
    """An inertial sample of the flight controller, in its body frame (FRD), on its clock. m/s^2 (specific force: -9.8
    down at rest) and rad/s. message: which one it came with (its stamps have an origin of their own). unit: which of
    several. RAW_IMU is taken to be in mg and mrad/s, as ArduPilot sends it.
    """

    t_us: int
    accel: tuple[float, float, float]
    gyro: tuple[float, float, float]
    message: int = HIGHRES_IMU
    unit: int = 0
    component: int = 1


@dataclass(frozen=True, slots=True)
class LocalPosition:
    """Message 32, LOCAL_POSITION_NED: where the flight controller's filter thinks it is. m and m/s in NED."""

    t_ms: int
    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Attitude:
    """Message 30. Roll, pitch, yaw in rad turn body FRD into NED, yaw first (z, y', x''); rates in body FRD, rad/s."""

    t_ms: int
    angles_rad: tuple[float, float, float]
    rate_rad_s: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class WheelDistance:
    """Message 9000. What each wheel has rolled since the start, in m, forward positive. At most 16."""

    t_us: int
    distance_m: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Odometry:
    """Message 331. Position in local FRD, q [w, x, y, z] from body FRD to local FRD, velocities in body FRD.

    system, component: of who sent it.
    """

    time_usec: int
    position_m: Sequence[float]
    q: Sequence[float]
    velocity_m_s: Sequence[float]
    rate_rad_s: Sequence[float]
    pose_covariance: Sequence[float]
    velocity_covariance: Sequence[float]
    reset_counter: int
    quality: int
    frame_id: int = 20  # MAV_FRAME_LOCAL_FRD: ArduPilot drops all others silently
    child_frame_id: int = 12  # MAV_FRAME_BODY_FRD: the same
    estimator_type: int = 3  # MAV_ESTIMATOR_TYPE_VIO: PX4 discards the covariance of a naive one
    system: int = 0
    component: int = 0


@dataclass(frozen=True, slots=True)
class Tunnel:
    """Message 385: bytes for somebody, carried by whoever is on the way. data: at most 128 bytes."""

    system: int
    component: int
    target_system: int
    target_component: int
    payload_type: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RadioStatus:
    """What a telemetry radio says of itself. txbuf: percent of its send buffer that is free."""

    txbuf: int
    rssi: int
    remote_rssi: int


Incoming = (
    Heartbeat | TimeSync | VehicleImu | Odometry | Tunnel | RadioStatus | LocalPosition | Attitude | WheelDistance
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Signing:
    """MAVLink 2 signing. key: 32 bytes. timestamp: in 10 us since 2015, never less than any used before (persist
    it). allow_unsigned: which message ids to accept unsigned (RADIO_STATUS, 109, is never signed).
    """

    key: bytes
    timestamp: int
    link_id: int = 0
    allow_unsigned: Callable[[int], bool] = lambda message_id: message_id == 109


class MavlinkCodec:
    """Bytes to messages and back, for one sender and one stream. Holds the sequence number and the parser's state."""

    def __init__(self, system: int = 1, component: int = COMPONENT_VIO, signing: Signing | None = None) -> None:
        self._mav: Any = common.MAVLink(None, srcSystem=system, srcComponent=component)
        self._mav.robust_parsing = True
        self.bad = 0  # pieces that were no valid message
        self.unknown = 0  # valid frames of messages that this dialect or this program does not know
        if signing is not None:
            if len(signing.key) != 32:
                raise ValueError(f"a MAVLink signing key has 32 bytes, found {len(signing.key)}")
            state = self._mav.signing
            state.secret_key = signing.key
            state.link_id = signing.link_id
            state.timestamp = signing.timestamp
            state.sign_outgoing = True
            state.allow_unsigned_callback = lambda mav, message_id: signing.allow_unsigned(message_id)

    @property
    def signing_timestamp(self) -> int:
        """The timestamp to persist."""
        return int(self._mav.signing.timestamp)

    def _pack(self, message: Any) -> bytes:
        data = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return data

    def heartbeat(self, *, type_: int = 18, autopilot: int = 8, armed: bool = False) -> bytes:
        """HEARTBEAT; by default of an onboard controller (18) that is no autopilot (8: invalid)."""
        base_mode = 128 if armed else 0
        return self._pack(common.MAVLink_heartbeat_message(type_, autopilot, base_mode, 0, 4, 3))  # 4: active

    def timesync(self, tc1_ns: int, ts1_ns: int) -> bytes:
        """TIMESYNC."""
        return self._pack(common.MAVLink_timesync_message(tc1_ns, ts1_ns))

    def highres_imu(self, sample: VehicleImu) -> bytes:
        """HIGHRES_IMU with accelerometer and gyroscope (as a flight controller sends it)."""
        m, zeros = sample, (0.0,) * 7
        return self._pack(
            common.MAVLink_highres_imu_message(m.t_us, *m.accel, *m.gyro, *zeros, _ACCEL_AND_GYRO, m.unit)
        )

    def message_interval(self, system: int, component: int, message_id: int, interval_us: int) -> bytes:
        """COMMAND_LONG MAV_CMD_SET_MESSAGE_INTERVAL: ask a flight controller for a stream."""
        return self._pack(
            common.MAVLink_command_long_message(
                system, component, 511, 0, float(message_id), float(interval_us), 0.0, 0.0, 0.0, 0.0, 0.0
            )
        )

    def odometry(self, o: Odometry) -> bytes:
        """ODOMETRY."""
        return self._pack(
            common.MAVLink_odometry_message(
                o.time_usec,
                o.frame_id,
                o.child_frame_id,
                *o.position_m,
                list(o.q),
                *o.velocity_m_s,
                *o.rate_rad_s,
                list(o.pose_covariance),
                list(o.velocity_covariance),
                o.reset_counter,
                o.estimator_type,
                o.quality,
            )
        )

    def local_position(self, p: LocalPosition) -> bytes:
        """LOCAL_POSITION_NED (as a flight controller sends it)."""
        return self._pack(common.MAVLink_local_position_ned_message(p.t_ms, *p.position_m, *p.velocity_m_s))

    def attitude(self, a: Attitude) -> bytes:
        """ATTITUDE (as a flight controller sends it)."""
        return self._pack(common.MAVLink_attitude_message(a.t_ms, *a.angles_rad, *a.rate_rad_s))

    def wheel_distance(self, w: WheelDistance) -> bytes:
        """WHEEL_DISTANCE (as a flight controller sends it)."""
        rolled = [*w.distance_m, *[0.0] * (16 - len(w.distance_m))]
        return self._pack(common.MAVLink_wheel_distance_message(w.t_us, len(w.distance_m), rolled))

    def tunnel(self, target_system: int, target_component: int, payload_type: int, data: bytes) -> bytes:
        """TUNNEL with up to 128 bytes."""
        padded = list(data) + [0] * (128 - len(data))
        return self._pack(
            common.MAVLink_tunnel_message(target_system, target_component, payload_type, len(data), padded)
        )  # fmt: skip

    def radio_status(self, txbuf: int, rssi: int = 200, remote_rssi: int = 200) -> bytes:
        """RADIO_STATUS, as a radio sends it."""
        return self._pack(common.MAVLink_radio_status_message(rssi, remote_rssi, txbuf, 30, 30, 0, 0))

    def receive(self, data: bytes, *, datagram: bool = False) -> list[Incoming]:
        """Take any bytes in any pieces; the messages that they completed. Never raises.

        datagram: the data are a whole datagram, so that a message never goes on in the next one.
        """
        if datagram:
            self._drop_buffer()
        self._mav.buf.extend(data)
        messages = []
        while (message := self._next()) is not None:
            understood = self._understand(message)
            if understood is not None:
                messages.append(understood)
        if self._mav.buf_index > _KEEP_BYTES:
            self._mav.buf = self._mav.buf[self._mav.buf_index :]
            self._mav.buf_index = 0
        return messages

    def _next(self) -> Any:
        """The next frame in the buffer, or None. What began like a frame and was none is searched for frames within:
        pymavlink alone would swallow up to 280 good bytes after one stray marker.
        """
        while True:
            try:
                message = self._mav.parse_char(b"")
            except Exception:  # whatever a generated decoder may raise on hostile bytes
                self.bad += 1
                self._drop_buffer()
                return None
            if message is None:
                return None
            kind = message.get_type()
            rest = self._mav.buf[self._mav.buf_index :]
            unsure = kind.startswith("UNKNOWN") and len(rest) > 0 and rest[0] not in _MARKERS  # has no checksum here
            if not (unsure or (kind == "BAD_DATA" and len(message.data) > 1 and message.data[0] in _MARKERS)):
                return message
            self.bad += 1
            self._mav.buf = bytearray(message.data[1:]) + rest
            self._mav.buf_index = 0
            self._mav.expected_length = _SHORTEST

    def _drop_buffer(self) -> None:
        self._mav.buf = bytearray()
        self._mav.buf_index = 0
        self._mav.expected_length = _SHORTEST

    def _understand(self, m: Any) -> Incoming | None:
        kind = m.get_type()
        if kind == "BAD_DATA":
            self.bad += 1
            return None
        system, component = m.get_srcSystem(), m.get_srcComponent()
        if kind == "HEARTBEAT":
            return Heartbeat(system, component, m.type, m.autopilot, bool(m.base_mode & 128))
        if kind == "TIMESYNC":
            return TimeSync(system, component, m.tc1, m.ts1)
        if kind in ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU"):
            return _inertial(m, kind, component)
        if kind == "ODOMETRY":
            return Odometry(
                m.time_usec,
                (m.x, m.y, m.z),
                tuple(m.q),
                (m.vx, m.vy, m.vz),
                (m.rollspeed, m.pitchspeed, m.yawspeed),
                tuple(m.pose_covariance),
                tuple(m.velocity_covariance),
                m.reset_counter,
                m.quality,
                m.frame_id,
                m.child_frame_id,
                m.estimator_type,
                system,
                component,
            )
        if kind == "LOCAL_POSITION_NED":
            return LocalPosition(m.time_boot_ms, (m.x, m.y, m.z), (m.vx, m.vy, m.vz))
        if kind == "ATTITUDE":
            angles, rate = (m.roll, m.pitch, m.yaw), (m.rollspeed, m.pitchspeed, m.yawspeed)
            return Attitude(m.time_boot_ms, angles, rate)
        if kind == "WHEEL_DISTANCE":
            return WheelDistance(m.time_usec, tuple(m.distance[: min(m.count, 16)]))
        if kind == "TUNNEL":
            payload = bytes(m.payload[: min(m.payload_length, 128)])
            return Tunnel(system, component, m.target_system, m.target_component, m.payload_type, payload)
        if kind == "RADIO_STATUS":
            return RadioStatus(m.txbuf, m.rssi, m.remrssi)
        self.unknown += 1
        return None


def _inertial(m: Any, kind: str, component: int) -> VehicleImu | None:
    accel, gyro = (m.xacc, m.yacc, m.zacc), (m.xgyro, m.ygyro, m.zgyro)
    if kind == "HIGHRES_IMU":
        whole = m.fields_updated & _ACCEL_AND_GYRO == _ACCEL_AND_GYRO
        return VehicleImu(m.time_usec, accel, gyro, HIGHRES_IMU, m.id, component) if whole else None
    accel, gyro = tuple(_MG * a for a in accel), tuple(1e-3 * g for g in gyro)
    if kind == "RAW_IMU":
        return VehicleImu(m.time_usec, accel, gyro, RAW_IMU, m.id, component)
    return VehicleImu(m.time_boot_ms * 1000, accel, gyro, SCALED_IMU, 0, component)

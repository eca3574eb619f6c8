"""The MAVLink 2 messages that kiteline uses, as dataclasses, and the table from which the codec parses and builds them.

Message ids, checksums and wire layouts come from pymavlink's generated dialect `common`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from pymavlink.dialects.v20 import common

COMPONENT_VIO = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
HIGHRES_IMU, RAW_IMU, SCALED_IMU = 105, 27, 26  # message ids
_ACCEL_AND_GYRO = 0x3F  # bits of HIGHRES_IMU's fields_updated
_MG = 9.80665e-3  # m/s^2 in a thousandth of standard gravity
_ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
_TUNNEL_BYTES = 128  # of TUNNEL's payload field
_NEAREST_CM = 20  # of an obstacle that is told; controllers ignore what is nearer

Vector = tuple[float, float, float]


class MavlinkMessage:
    """Base class of messages. NAMES: in the dialect; all of them are parsed, the first one is built.

    FROM_ANY_SYSTEM: not only those of the vehicle are taken.
    """

    __slots__ = ()
    NAMES: ClassVar[tuple[str, ...]]
    FROM_ANY_SYSTEM: ClassVar[bool] = False

    @classmethod
    def parse(cls, m: Any) -> Self | None:
        """The message of pymavlink's generated object, or None if it holds nothing of use."""
        raise NotImplementedError

    def values(self) -> Sequence[Any]:
        """The arguments of the dialect's generated constructor."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class Heartbeat(MavlinkMessage):
    """A component is alive; by default an onboard controller (18) that is no autopilot (8: invalid). armed: may fly."""

    NAMES = ("HEARTBEAT",)
    FROM_ANY_SYSTEM = True
    type: int = 18
    autopilot: int = 8
    armed: bool = False
    system: int = 0
    component: int = 0

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.type, m.autopilot, bool(m.base_mode & _ARMED), m.get_srcSystem(), m.get_srcComponent())

    def values(self) -> Sequence[Any]:
        return self.type, self.autopilot, _ARMED if self.armed else 0, 0, 4, 3  # state 4: active

    @property
    def is_autopilot(self) -> bool:
        """True for a flight controller, not for a companion, camera or ground station."""
        return self.component == 1 and self.autopilot != int(common.MAV_AUTOPILOT_INVALID)


@dataclass(frozen=True, slots=True)
class TimeSync(MavlinkMessage):
    """tc1_ns == 0: a request, stamped ts1_ns by its sender; else the response to it."""

    NAMES = ("TIMESYNC",)
    tc1_ns: int
    ts1_ns: int
    system: int = 0
    component: int = 0

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.tc1, m.ts1, m.get_srcSystem(), m.get_srcComponent())

    def values(self) -> Sequence[Any]:
        return self.tc1_ns, self.ts1_ns


def is_complete_sample(fields_updated: int) -> bool:
    """True if a HIGHRES_IMU holds acceleration and angular rate."""
    return fields_updated & _ACCEL_AND_GYRO == _ACCEL_AND_GYRO


@dataclass(frozen=True, slots=True)
class VehicleImu(MavlinkMessage):
    """An inertial sample of the flight controller, in its body frame (FRD), on its clock.

    accel: m/s^2 (specific force: -9.8 down at rest). gyro: rad/s. message: id of the message that held it (each has a
    clock origin of its own). unit: number of the sensor. RAW_IMU is taken to be in mg and mrad/s, as sent by ArduPilot.
    """

    NAMES = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU")
    t_us: int
    accel: Vector
    gyro: Vector
    message: int = HIGHRES_IMU
    unit: int = 0
    component: int = 1

    @classmethod
    def parse(cls, m: Any) -> Self | None:
        accel, gyro, message = (m.xacc, m.yacc, m.zacc), (m.xgyro, m.ygyro, m.zgyro), m.get_msgId()
        if message == HIGHRES_IMU:
            if not is_complete_sample(m.fields_updated):
                return None
            return cls(m.time_usec, accel, gyro, HIGHRES_IMU, m.id, m.get_srcComponent())
        accel, gyro = tuple(_MG * a for a in accel), tuple(1e-3 * g for g in gyro)
        if message == RAW_IMU:
            return cls(m.time_usec, accel, gyro, RAW_IMU, m.id, m.get_srcComponent())
        return cls(m.time_boot_ms * 1000, accel, gyro, SCALED_IMU, 0, m.get_srcComponent())

    def values(self) -> Sequence[Any]:
        return self.t_us, *self.accel, *self.gyro, *(0.0,) * 7, _ACCEL_AND_GYRO, self.unit


@dataclass(frozen=True, slots=True)
class LocalPosition(MavlinkMessage):
    """Position (m) and velocity (m/s) in NED, as the flight controller's filter estimates them."""

    NAMES = ("LOCAL_POSITION_NED",)
    t_ms: int
    position_m: Vector
    velocity_m_s: Vector

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.time_boot_ms, (m.x, m.y, m.z), (m.vx, m.vy, m.vz))

    def values(self) -> Sequence[Any]:
        return self.t_ms, *self.position_m, *self.velocity_m_s


@dataclass(frozen=True, slots=True)
class Attitude(MavlinkMessage):
    """Roll, pitch, yaw in rad rotate body FRD into NED, yaw first (z, y', x''); rates in body FRD, rad/s."""

    NAMES = ("ATTITUDE",)
    t_ms: int
    angles_rad: Vector
    rate_rad_s: Vector
    system: int = 0

    @classmethod
    def parse(cls, m: Any) -> Self:
        rates = m.rollspeed, m.pitchspeed, m.yawspeed
        return cls(m.time_boot_ms, (m.roll, m.pitch, m.yaw), rates, m.get_srcSystem())

    def values(self) -> Sequence[Any]:
        return self.t_ms, *self.angles_rad, *self.rate_rad_s


@dataclass(frozen=True, slots=True)
class WheelDistance(MavlinkMessage):
    """Distance in m that each wheel has rolled since the start, forward positive. At most 16 wheels."""

    NAMES = ("WHEEL_DISTANCE",)
    t_us: int
    distance_m: tuple[float, ...]

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.time_usec, tuple(m.distance[: min(m.count, 16)]))

    def values(self) -> Sequence[Any]:
        n = len(self.distance_m)
        return self.t_us, n, [*self.distance_m, *[0.0] * (16 - n)]


@dataclass(frozen=True, slots=True)
class Odometry(MavlinkMessage):
    """Position in local FRD, q [w, x, y, z] from body FRD to local FRD, velocities in body FRD.

    Covariances: the 21 numbers of the upper right triangle. system, component: of the sender.
    """

    NAMES = ("ODOMETRY",)
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

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(
            m.time_usec, (m.x, m.y, m.z), tuple(m.q), (m.vx, m.vy, m.vz), (m.rollspeed, m.pitchspeed, m.yawspeed),
            tuple(m.pose_covariance), tuple(m.velocity_covariance), m.reset_counter, m.quality, m.frame_id,
            m.child_frame_id, m.estimator_type, m.get_srcSystem(), m.get_srcComponent(),
        )  # fmt: skip

    def values(self) -> Sequence[Any]:
        return (
            self.time_usec, self.frame_id, self.child_frame_id, *self.position_m, list(self.q), *self.velocity_m_s,
            *self.rate_rad_s, list(self.pose_covariance), list(self.velocity_covariance), self.reset_counter,
            self.estimator_type, self.quality,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Tunnel(MavlinkMessage):
    """Opaque bytes (at most 128) for a target, forwarded by routers on the way."""

    NAMES = ("TUNNEL",)
    FROM_ANY_SYSTEM = True
    target_system: int
    target_component: int
    payload_type: int
    data: bytes
    system: int = 0
    component: int = 0

    @classmethod
    def parse(cls, m: Any) -> Self:
        data = bytes(m.payload[: min(m.payload_length, _TUNNEL_BYTES)])
        return cls(
            m.target_system, m.target_component, m.payload_type, data, m.get_srcSystem(), m.get_srcComponent()
        )  # fmt: skip

    def values(self) -> Sequence[Any]:
        n = len(self.data)
        return self.target_system, self.target_component, self.payload_type, n, [*self.data, *[0] * (_TUNNEL_BYTES - n)]


@dataclass(frozen=True, slots=True)
class RadioStatus(MavlinkMessage):
    """State of a telemetry radio. txbuf: percent of its send buffer that is free."""

    NAMES = ("RADIO_STATUS",)
    FROM_ANY_SYSTEM = True
    txbuf: int
    rssi: int = 200
    remote_rssi: int = 200
    noise: int = 30

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.txbuf, m.rssi, m.remrssi, m.noise)

    def values(self) -> Sequence[Any]:
        return self.rssi, self.remote_rssi, self.txbuf, self.noise, self.noise, 0, 0


@dataclass(frozen=True, slots=True)
class MessageInterval(MavlinkMessage):
    """Command MAV_CMD_SET_MESSAGE_INTERVAL: requests a stream of messages from a flight controller. Only built."""

    NAMES = ("COMMAND_LONG",)
    target_system: int
    target_component: int
    message_id: int
    interval_us: int

    def values(self) -> Sequence[Any]:
        target = self.target_system, self.target_component
        return *target, 511, 0, float(self.message_id), float(self.interval_us), 0.0, 0.0, 0.0, 0.0, 0.0


@dataclass(frozen=True, slots=True)
class VisionPosition(MavlinkMessage):
    """Position in local FRD (m), roll, pitch and yaw (rad): the older form of a pose. Only built."""

    NAMES = ("VISION_POSITION_ESTIMATE",)
    time_usec: int
    position_m: Sequence[float]
    angles_rad: Sequence[float]
    covariance: Sequence[float]
    reset_counter: int

    def values(self) -> Sequence[Any]:
        return self.time_usec, *self.position_m, *self.angles_rad, list(self.covariance), self.reset_counter


@dataclass(frozen=True, slots=True)
class VisionSpeed(MavlinkMessage):
    """Velocity in local FRD (m/s), with a covariance of 9 numbers. Only built."""

    NAMES = ("VISION_SPEED_ESTIMATE",)
    time_usec: int
    velocity_m_s: Sequence[float]
    covariance: Sequence[float]
    reset_counter: int

    def values(self) -> Sequence[Any]:
        return self.time_usec, *self.velocity_m_s, list(self.covariance), self.reset_counter


@dataclass(frozen=True, slots=True)
class GlobalOrigin(MavlinkMessage):
    """Latitude and longitude in 1e-7 degrees, altitude in mm, of the local frame's origin: the controller's."""

    NAMES = ("GPS_GLOBAL_ORIGIN",)
    latitude: int
    longitude: int
    altitude_mm: int

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.latitude, m.longitude, m.altitude)

    def values(self) -> Sequence[Any]:
        return self.latitude, self.longitude, self.altitude_mm


@dataclass(frozen=True, slots=True)
class SetGlobalOrigin(MavlinkMessage):
    """Asks a flight controller to take an origin for its local frame. Only built."""

    NAMES = ("SET_GPS_GLOBAL_ORIGIN",)
    target_system: int
    origin: GlobalOrigin

    def values(self) -> Sequence[Any]:
        return self.target_system, self.origin.latitude, self.origin.longitude, self.origin.altitude_mm


@dataclass(frozen=True, slots=True)
class ComputerStatus(MavlinkMessage):
    """Load and temperature of the companion computer. cpu_percent: of each core. None: unknown. Only built."""

    NAMES = ("ONBOARD_COMPUTER_STATUS",)
    t_us: int
    uptime_ms: int
    cpu_percent: Sequence[int]
    ram_mib: int | None
    ram_total_mib: int | None
    temperature_c: int | None

    def values(self) -> Sequence[Any]:
        n, unknown = min(len(self.cpu_percent), 8), 255
        cores = [*self.cpu_percent[:n], *[unknown] * (8 - n)]
        combined = [round(sum(self.cpu_percent) / len(self.cpu_percent)) if n else unknown, *[unknown] * 9]
        no_word, no_disk = 2**32 - 1, [2**32 - 1] * 4
        ram = no_word if self.ram_mib is None else self.ram_mib
        total = no_word if self.ram_total_mib is None else self.ram_total_mib
        degrees = 127 if self.temperature_c is None else max(-126, min(126, self.temperature_c))
        return (
            self.t_us, self.uptime_ms % 2**32, 0, cores, combined, [unknown] * 4, [unknown] * 10, 127,
            [degrees, *[127] * 7], [2**15 - 1] * 4, ram, total, no_disk, no_disk, no_disk, *[[2**32 - 1] * 6] * 5,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class ObstacleDistance(MavlinkMessage):
    """Distances around the vehicle, the first one ahead, then clockwise. Only built.

    distance_m: at most 72; inf: nothing up to reach_m; nan: unknown.
    """

    NAMES = ("OBSTACLE_DISTANCE",)
    t_us: int
    distance_m: Sequence[float]
    reach_m: float

    def values(self) -> Sequence[Any]:
        n, reach_cm, unknown = len(self.distance_m), round(100 * self.reach_m), 2**16 - 1
        cm = [unknown if d != d else min(reach_cm + 1, max(_NEAREST_CM, round(100 * min(d, 600.0))))
              for d in self.distance_m]  # fmt: skip
        width = 360.0 / n
        sensor = 4  # MAV_DISTANCE_SENSOR_UNKNOWN: a map
        return (
            self.t_us, sensor, [*cm, *[unknown] * (72 - n)], round(width), _NEAREST_CM, reach_cm, width, 0.0,
            int(common.MAV_FRAME_BODY_FRD),
        )  # fmt: skip


# The messages that are parsed; others are counted as unknown.
MESSAGES: tuple[type[MavlinkMessage], ...] = (
    Heartbeat, TimeSync, VehicleImu, LocalPosition, Attitude, WheelDistance, Odometry, Tunnel, RadioStatus,
    GlobalOrigin,
)  # fmt: skip

"""A model of what ArduPilot and PX4 tell a companion: streams, parameters, version, the state of the estimator.

It models the protocol, not the flight: the true attitude is handed in, and its estimator has a position when poses
arrive and its parameters let it use them. Sources: ArduPilot's GCS_Common, GCS_Param and NavEKF3; PX4's
mavlink_parameters and EKF2.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import (
    HIGHRES_IMU,
    Attitude,
    Heartbeat,
    LocalPosition,
    MavlinkMessage,
    Odometry,
    TimeSync,
    Vector,
    VehicleImu,
)
from kiteline_hw.mavlink.watch import messages as wire
from kiteline_hw.mavlink.watch.messages import (
    AutopilotVersion,
    Command,
    CommandAck,
    EkfStatusReport,
    EstimatorStatus,
    ParamRequest,
    ParamValue,
    StatusText,
)

ARDUPILOT_PARAMETERS = {  # those of a vehicle that is set up well, with the companion at SERIAL2
    "AHRS_EKF_TYPE": 3, "EK3_ENABLE": 1, "VISO_TYPE": 3, "VISO_ORIENT": 0, "VISO_SCALE": 1, "VISO_DELAY_MS": 10,
    "VISO_QUAL_MIN": 0, "VISO_POS_X": 0, "VISO_POS_Y": 0, "VISO_POS_Z": 0, "EK3_SRC1_POSXY": 6, "EK3_SRC1_VELXY": 6,
    "EK3_SRC1_POSZ": 6, "EK3_SRC1_VELZ": 6, "EK3_SRC1_YAW": 6, "SERIAL1_PROTOCOL": 2, "SERIAL1_BAUD": 57,
    "SERIAL1_OPTIONS": 0, "SERIAL2_PROTOCOL": 2, "SERIAL2_BAUD": 921, "SERIAL2_OPTIONS": 1024, "SERIAL3_PROTOCOL": 5,
}  # fmt: skip
PX4_PARAMETERS = {  # likewise, with the companion at MAVLink instance 1
    "EKF2_EN": 1, "EKF2_EV_CTRL": 15, "EKF2_HGT_REF": 3, "EKF2_EV_DELAY": 0.0, "EKF2_EV_POS_X": 0.0,
    "EKF2_EV_POS_Y": 0.0, "EKF2_EV_POS_Z": 0.0, "EKF2_EV_NOISE_MD": 0, "EKF2_EV_QMIN": 1, "MAV_0_CONFIG": 101,
    "MAV_0_FORWARD": 0, "MAV_1_CONFIG": 102, "MAV_1_FORWARD": 0, "MAV_2_CONFIG": 0,
}  # fmt: skip

_HEALTHY_FLAGS = 1 | 2 | 4 | 8 | 16 | 32 | 256 | 512
_BLIND_FLAGS = 1 | 4 | 32 | 128
_HEARTBEAT_NS = 1_000_000_000
_FUSED_AFTER_NS = 1_000_000_000  # ns of poses until they are fused
_AIDING_TIMEOUT_NS = {"ardupilot": 15_000_000_000, "px4": 5_000_000_000}  # ns without them until it has no position
_SLEW_RAD_S = math.radians(15.0)  # of EKF3's yaw towards that of poses, as seen in the loop
_LOCAL_POSITION = 32  # message id
_TIMESYNC_NS = {"ardupilot": 10_000_000_000, "px4": 100_000_000}


@dataclass(slots=True)
class Faults:
    """What is wrong with the modelled controller."""

    silent: bool = False  # sends nothing
    deaf: bool = False  # processes nothing that it is sent
    rejects: bool = False  # its innovations are beyond the limit
    fixed_rates: bool = False  # refuses SET_MESSAGE_INTERVAL
    no_timesync: bool = False  # answers no TIMESYNC


@dataclass(slots=True)
class _Stream:
    interval_ns: int
    next_ns: int


@dataclass(slots=True)
class ModelledAutopilot:
    """Bytes in, bytes out, time handed in. parameters: replaces some; None: the parameter does not exist."""

    kind: Literal["ardupilot", "px4"]
    system: int = 1
    parameters: Mapping[str, float | None] = field(default_factory=dict)
    faults: Faults = field(default_factory=Faults)
    version: int = 4 << 24 | 6 << 16 | 3 << 8 | 255
    armed: bool = False
    angles_rad: Vector = (0.0, 0.0, 0.0)
    rate_rad_s: Vector = (0.0, 0.0, 0.0)
    position_m: Vector = (0.0, 0.0, 0.0)
    turns_with_poses: bool = False  # its yaw and position follow the poses, as EKF3's with EK3_SRC1_YAW 6
    texts: list[StatusText] = field(default_factory=list)  # received
    codec: MavlinkCodec = field(init=False)
    _values: dict[str, float] = field(init=False)
    _streams: dict[int, _Stream] = field(default_factory=dict)
    _boot_ns: int | None = None
    _next_heartbeat_ns: int = 0
    _next_timesync_ns: int = 0
    _first_pose_ns: int | None = None
    _last_pose_ns: int | None = None
    _fused: bool = False

    def __post_init__(self) -> None:
        """Fill the parameters."""
        self.codec = MavlinkCodec(self.system, 1)
        defaults: Mapping[str, float] = ARDUPILOT_PARAMETERS if self.kind == "ardupilot" else PX4_PARAMETERS
        named = {**defaults, **self.parameters}
        self._values = {name: value for name, value in named.items() if value is not None}

    @property
    def uses_vision(self) -> bool:
        """True if the parameters let the estimator use poses."""
        v = self._values
        if self.kind == "ardupilot":
            return v.get("VISO_TYPE", 0) > 0 and v.get("EK3_SRC1_POSXY") == 6
        return bool(int(v.get("EKF2_EV_CTRL", 0)) & 1)

    def reboot(self) -> None:
        """Begin anew: streams, estimator and clock."""
        self._boot_ns = self._first_pose_ns = self._last_pose_ns = None
        self._fused = False
        self._streams.clear()

    def receive(self, data: bytes, now_ns: int) -> list[bytes]:
        """Process bytes; the answers."""
        answers: list[MavlinkMessage] = []
        for message in self.codec.receive(data, datagram=True):
            if self.faults.deaf:
                continue
            match message:
                case Odometry():
                    self._pose(message, now_ns)
                case TimeSync(tc1_ns=0) if not self.faults.no_timesync:
                    answers.append(TimeSync(now_ns, message.ts1_ns))
                case ParamRequest(target_system=self.system, name=name) if name in self._values:
                    answers.append(self._parameter(name))
                case Command(target_system=self.system):
                    answers += self._command(message, now_ns)
                case StatusText():
                    self.texts.append(message)
        return [] if self.faults.silent else [self.codec.encode(m) for m in answers]

    def _pose(self, m: Odometry, now_ns: int) -> None:
        if m.quality < 0:
            return
        if self._last_pose_ns is None or now_ns - self._last_pose_ns > _AIDING_TIMEOUT_NS[self.kind]:
            self._first_pose_ns = now_ns
        elif self.turns_with_poses:
            self._turn(m, (now_ns - self._last_pose_ns) * 1e-9)
        self._last_pose_ns = now_ns

    def _turn(self, m: Odometry, dt_s: float) -> None:
        """Pull the yaw to that of a pose; take over its position."""
        w, x, y, z = m.q
        roll, pitch, yaw = self.angles_rad
        off = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) - yaw
        off = math.atan2(math.sin(off), math.cos(off))
        yaw += max(-_SLEW_RAD_S * dt_s, min(_SLEW_RAD_S * dt_s, off))
        self.angles_rad = roll, pitch, yaw
        self.position_m = m.position_m[0], m.position_m[1], m.position_m[2]

    def _parameter(self, name: str) -> ParamValue:
        value = self._values[name]
        if self.kind == "px4" and isinstance(value, int):
            return ParamValue.of_px4(name, value)
        return ParamValue(name, float(value), 9)

    def _command(self, m: Command, now_ns: int) -> list[MavlinkMessage]:
        if m.command == wire.REQUEST_MESSAGE and m.param1 == wire.AUTOPILOT_VERSION:
            return [CommandAck(m.command, 0), AutopilotVersion(self.version)]
        if m.command == wire.SET_MESSAGE_INTERVAL and not self.faults.fixed_rates:
            if m.param2 > 0.0:
                self._streams[int(m.param1)] = _Stream(round(m.param2 * 1e3), now_ns)
            else:
                self._streams.pop(int(m.param1), None)
            return [CommandAck(m.command, 0)]
        return [CommandAck(m.command, 3)]  # unsupported

    def poll(self, now_ns: int) -> list[bytes]:
        """The messages that it sends by itself."""
        if self._boot_ns is None:
            self._boot_ns = now_ns
        out: list[MavlinkMessage] = []
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + _HEARTBEAT_NS
            out.append(Heartbeat(2, wire.ARDUPILOT if self.kind == "ardupilot" else wire.PX4, self.armed))
        if now_ns >= self._next_timesync_ns:
            self._next_timesync_ns = now_ns + _TIMESYNC_NS[self.kind]
            out.append(TimeSync(0, now_ns))
        out += self._estimator_texts(now_ns)
        for message, stream in self._streams.items():
            if now_ns >= stream.next_ns:
                stream.next_ns = max(stream.next_ns + stream.interval_ns, now_ns - stream.interval_ns)
                out += self._streamed(message, now_ns - self._boot_ns, now_ns)
        return [] if self.faults.silent else [self.codec.encode(m) for m in out]

    def _streamed(self, message: int, boot_ns: int, now_ns: int) -> list[MavlinkMessage]:
        ratio = 1.7 if self.faults.rejects else 0.2
        flags = _HEALTHY_FLAGS if self.has_position(now_ns) else _BLIND_FLAGS
        if message == wire.ATTITUDE:
            return [Attitude(boot_ns // 1_000_000, self.angles_rad, self.rate_rad_s)]
        if message == _LOCAL_POSITION:
            return [LocalPosition(boot_ns // 1_000_000, self.position_m, (0.0, 0.0, 0.0))]
        if message == HIGHRES_IMU:
            return [VehicleImu(boot_ns // 1_000, (0.0, 0.0, -9.81), self.rate_rad_s)]
        if message == wire.EKF_STATUS_REPORT and self.kind == "ardupilot":
            return [EkfStatusReport(flags, ratio, ratio)]
        if message == wire.ESTIMATOR_STATUS and self.kind == "px4":
            return [EstimatorStatus(flags, ratio, ratio)]
        return []

    def has_position(self, now_ns: int) -> bool:
        """True while the estimator has a horizontal position: by poses, or by dead reckoning after them."""
        first, last = self._first_pose_ns, self._last_pose_ns
        if first is None or last is None or not self.uses_vision:
            return False
        return last - first >= _FUSED_AFTER_NS and now_ns - last < _AIDING_TIMEOUT_NS[self.kind]

    def _estimator_texts(self, now_ns: int) -> list[MavlinkMessage]:
        before, self._fused = self._fused, self.has_position(now_ns)
        if self.kind != "ardupilot" or before == self._fused:
            return []
        text = "EKF3 IMU0 is using external nav data" if self._fused else "EKF3 IMU0 stopped aiding"
        return [StatusText(6, text)]

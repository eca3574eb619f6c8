"""The MAVLink messages by which a flight controller reports its state: estimator, version, parameters, texts."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from pymavlink.dialects.v20 import common

from kiteline_hw.mavlink.messages import MavlinkMessage

ATTITUDE, AUTOPILOT_VERSION, EKF_STATUS_REPORT, ESTIMATOR_STATUS = 30, 148, 193, 230  # ids
REQUEST_MESSAGE, SET_MESSAGE_INTERVAL = 512, 511  # commands
ARDUPILOT, PX4 = 3, 12  # MAV_AUTOPILOT
POSITION_FLAGS = 8 | 16  # the estimator knows its horizontal position: relative, absolute
NO_AIDING_FLAG = 128  # it assumes a constant position, for want of one that is measured
_INTEGER_TYPES = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i"}  # MAV_PARAM_TYPE


class _EkfStatusReport(common.MAVLink_message):  # type: ignore[misc]
    """EKF_STATUS_REPORT of ArduPilot's dialect, which pymavlink's `common` lacks."""

    id = EKF_STATUS_REPORT
    msgname = name = "EKF_STATUS_REPORT"
    fieldnames: ClassVar = ["flags", "velocity", "position", "height", "compass", "terrain", "airspeed"]
    ordered_fieldnames: ClassVar = [*fieldnames[1:6], "flags", "airspeed"]
    fieldtypes: ClassVar = ["uint16_t", *["float"] * 6]
    fielddisplays_by_name: ClassVar[dict[str, str]] = {}
    fieldenums_by_name: ClassVar[dict[str, str]] = {}
    fieldunits_by_name: ClassVar[dict[str, str]] = {}
    orders: ClassVar = [5, 0, 1, 2, 3, 4, 6]
    lengths: ClassVar = [1] * 7
    array_lengths: ClassVar = [0] * 7
    crc_extra = 71
    unpacker = struct.Struct("<fffffHf")
    native_format = bytearray(b"<fffffHf")
    instance_field = None
    instance_offset = -1

    def __init__(self, flags: int, *ratios: float) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field, self._instance_offset = None, -1
        self.flags = flags
        self.velocity, self.position, self.height, self.compass, self.terrain, self.airspeed = ratios

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The frame, as pymavlink's generated messages do."""
        five = self.velocity, self.position, self.height, self.compass, self.terrain
        payload = self.unpacker.pack(*five, self.flags, self.airspeed)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


common.mavlink_map.setdefault(EKF_STATUS_REPORT, _EkfStatusReport)
if not hasattr(common, "MAVLink_ekf_status_report_message"):
    common.MAVLink_ekf_status_report_message = _EkfStatusReport


@dataclass(frozen=True, slots=True)
class FilterStatus(MavlinkMessage):
    """State of an autopilot's filter. Ratios of innovation to limit: above 1 measurements are rejected."""

    flags: int
    velocity_ratio: float = 0.0
    position_ratio: float = 0.0
    height_ratio: float = 0.0
    system: int = 0


@dataclass(frozen=True, slots=True)
class EstimatorStatus(FilterStatus):
    """State of PX4's filter (ESTIMATOR_STATUS)."""

    NAMES = ("ESTIMATOR_STATUS",)

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.flags, m.vel_ratio, m.pos_horiz_ratio, m.pos_vert_ratio, m.get_srcSystem())

    def values(self) -> Sequence[Any]:
        return 0, self.flags, self.velocity_ratio, self.position_ratio, self.height_ratio, *(0.0,) * 5


@dataclass(frozen=True, slots=True)
class EkfStatusReport(FilterStatus):
    """State of ArduPilot's filter: what it calls variances are test ratios."""

    NAMES = ("EKF_STATUS_REPORT",)

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.flags, m.velocity, m.position, m.height, m.get_srcSystem())

    def values(self) -> Sequence[Any]:
        return self.flags, self.velocity_ratio, self.position_ratio, self.height_ratio, 0.0, 0.0, 0.0


@dataclass(frozen=True, slots=True)
class AutopilotVersion(MavlinkMessage):
    """Firmware of a flight controller: version, its four bytes major, minor, patch and kind of release."""

    NAMES = ("AUTOPILOT_VERSION",)
    version: int
    system: int = 0

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.flight_sw_version, m.get_srcSystem())

    def values(self) -> Sequence[Any]:
        return 0, self.version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0

    @property
    def text(self) -> str:
        """The version as people write it: 4.7.0-dev."""
        v = self.version
        kinds = {0: "-dev", 64: "-alpha", 128: "-beta", 192: "-rc", 255: ""}  # FIRMWARE_VERSION_TYPE
        return f"{v >> 24 & 255}.{v >> 16 & 255}.{v >> 8 & 255}{kinds.get(v & 255, '')}"


@dataclass(frozen=True, slots=True)
class ParamRequest(MavlinkMessage):
    """PARAM_REQUEST_READ: asks for a parameter by its name."""

    NAMES = ("PARAM_REQUEST_READ",)
    target_system: int
    target_component: int
    name: str

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.target_system, m.target_component, m.param_id)

    def values(self) -> Sequence[Any]:
        return self.target_system, self.target_component, self.name.encode("ascii"), -1


@dataclass(frozen=True, slots=True)
class ParamValue(MavlinkMessage):
    """A parameter. field: as on the wire. type: MAV_PARAM_TYPE, 6: a 32 bit integer, 9: a float."""

    NAMES = ("PARAM_VALUE",)
    name: str
    field: float
    type: int = 9
    system: int = 0

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.param_id, m.param_value, m.param_type, m.get_srcSystem())

    def values(self) -> Sequence[Any]:
        return self.name.encode("ascii"), self.field, self.type, 1, 0

    def number(self, autopilot: int) -> float:
        """The value. PX4 puts the bytes of an integer into the field, ArduPilot its value."""
        layout = _INTEGER_TYPES.get(self.type)
        if autopilot != PX4 or layout is None:
            return self.field
        return float(struct.unpack_from(layout, struct.pack("<f", self.field))[0])

    @classmethod
    def of_px4(cls, name: str, value: int) -> Self:
        """An integer parameter as PX4 sends it."""
        return cls(name, struct.unpack("<f", struct.pack("<i", value))[0], 6)


@dataclass(frozen=True, slots=True)
class StatusText(MavlinkMessage):
    """A text for people, at most 50 characters. severity: MAV_SEVERITY, 0 emergency to 7 debug."""

    NAMES = ("STATUSTEXT",)
    severity: int
    text: str
    system: int = 0
    component: int = 0

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.severity, m.text, m.get_srcSystem(), m.get_srcComponent())

    def values(self) -> Sequence[Any]:
        return self.severity, self.text.encode("ascii", "replace")[:50], 0, 0


@dataclass(frozen=True, slots=True)
class Command(MavlinkMessage):
    """COMMAND_LONG with its first two parameters."""

    NAMES = ("COMMAND_LONG",)
    target_system: int
    target_component: int
    command: int
    param1: float
    param2: float = 0.0

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.target_system, m.target_component, m.command, m.param1, m.param2)

    def values(self) -> Sequence[Any]:
        return self.target_system, self.target_component, self.command, 0, self.param1, self.param2, *(0.0,) * 5


@dataclass(frozen=True, slots=True)
class CommandAck(MavlinkMessage):
    """Whether a command was carried out. result: MAV_RESULT, 0: accepted."""

    NAMES = ("COMMAND_ACK",)
    command: int
    result: int
    system: int = 0

    @classmethod
    def parse(cls, m: Any) -> Self:
        return cls(m.command, m.result, m.get_srcSystem())

    def values(self) -> Sequence[Any]:
        return self.command, self.result


MESSAGES: tuple[type[MavlinkMessage], ...] = (
    EkfStatusReport, EstimatorStatus, AutopilotVersion, ParamRequest, ParamValue, StatusText, Command, CommandAck,
)  # fmt: skip

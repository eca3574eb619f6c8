"""Decodes ROS 2 messages that are a header and 64-bit floats alone: inertial samples and poses.

The decoder of mcap_ros2 reads any schema, one field at a time: of an IMU at 200 Hz that takes a share of a core.
"""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

from mcap.records import Schema

_HEAD = struct.Struct("<iII")  # seconds, nanoseconds, bytes of the frame's name with its final zero
_LITTLE_ENDIAN = b"\x00\x01"  # encapsulation: plain CDR


class Stamp(NamedTuple):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """std_msgs/Header."""

    stamp: Stamp
    frame_id: str


class Vector(NamedTuple):
    """geometry_msgs/Vector3 or Point."""

    x: float
    y: float
    z: float


class Quaternion(NamedTuple):
    """geometry_msgs/Quaternion."""

    x: float
    y: float
    z: float
    w: float


class Imu(NamedTuple):
    """What is read of sensor_msgs/Imu."""

    header: Header
    angular_velocity: Vector
    linear_acceleration: Vector


class Pose(NamedTuple):
    """geometry_msgs/Pose."""

    position: Vector
    orientation: Quaternion


class PoseStamped(NamedTuple):
    """geometry_msgs/PoseStamped."""

    header: Header
    pose: Pose


def _imu(header: Header, v: tuple[float, ...]) -> Imu:
    return Imu(header, Vector(*v[13:16]), Vector(*v[25:28]))  # after the orientation; each with nine covariances


def _pose(header: Header, v: tuple[float, ...]) -> PoseStamped:
    return PoseStamped(header, Pose(Vector(*v[:3]), Quaternion(*v[3:])))


Fields = list[tuple[str, str]]  # type, without its package, and name

_IMU: Fields = [
    ("Header", "header"), ("Quaternion", "orientation"), ("float64[9]", "orientation_covariance"),
    ("Vector3", "angular_velocity"), ("float64[9]", "angular_velocity_covariance"),
    ("Vector3", "linear_acceleration"), ("float64[9]", "linear_acceleration_covariance"),
]  # fmt: skip
_FLOATS_XYZ: Fields = [("float64", axis) for axis in "xyz"]
_PARTS: dict[str, Fields] = {
    "Header": [("Time", "stamp"), ("string", "frame_id")],
    "Time": [("int32", "sec"), ("uint32", "nanosec")],
    "Quaternion": [*_FLOATS_XYZ, ("float64", "w")],
    "Vector3": _FLOATS_XYZ,
    "Point": _FLOATS_XYZ,
    "Pose": [("Point", "position"), ("Quaternion", "orientation")],
}
# By schema: its own fields, the definitions that they need, the number of floats, and what makes the message of them.
_KINDS: dict[str, tuple[Fields, tuple[str, ...], int, Callable[[Header, tuple[float, ...]], Any]]] = {
    "sensor_msgs/msg/Imu": (_IMU, ("Header", "Time", "Quaternion", "Vector3"), 37, _imu),
    "geometry_msgs/msg/PoseStamped": (
        [("Header", "header"), ("Pose", "pose")], ("Header", "Time", "Pose", "Point", "Quaternion"), 7, _pose,
    ),
}  # fmt: skip


def fast_decoder(schema: Schema | None, decode: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    """A decoder that is as `decode`, but fast if the schema is one of those above, field by field.

    Decoders raise what `struct` and `str` raise of bytes that are no such message.
    """
    known = _KINDS.get(schema.name) if schema is not None and schema.encoding == "ros2msg" else None
    if known is None or schema is None:
        return decode
    own, parts, count, make = known
    fields = _fields(schema.data.decode("utf-8", "replace"))
    if fields.get("") != own or any(fields.get(part) != _PARTS[part] for part in parts):
        return decode
    numbers = struct.Struct(f"<{count}d")

    def fast(data: bytes) -> Any:
        if data[:2] != _LITTLE_ENDIAN:
            return decode(data)
        sec, nanosec, length = _HEAD.unpack_from(data, 4)
        end = 16 + length
        values = numbers.unpack_from(data, 4 + (end + 3) // 8 * 8)  # aligned from byte 4 on
        return make(Header(Stamp(sec, nanosec), data[16 : end - 1].decode() if length else ""), values)

    return fast


def _fields(text: str) -> dict[str, Fields]:
    """Fields of each definition in a schema, by the last part of its name; "": of the message itself."""
    out: dict[str, Fields] = {"": []}
    name = ""
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if words[:1] == ["MSG:"]:
            name = words[-1].rpartition("/")[2]
            out[name] = []
        elif len(words) >= 2:
            out[name].append((words[0].rpartition("/")[2], " ".join(words[1:])))
    return out

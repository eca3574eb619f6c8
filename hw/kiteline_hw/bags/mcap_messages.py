"""Messages of ROS 2 (CDR) and Foxglove (protobuf, JSON), brought to one form whatever their encoding."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders
from numpy.typing import NDArray

from kiteline_core.frame import EncodedImage, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_hw.logs.mcap_log_read import read_odometry
from kiteline_hw.sensors.images import sniff
from kiteline_hw.sensors.odometry_buffer import RATE_SIGMA_RAD_S, VELOCITY_SIGMA_M_S, stated_variances
from kiteline_hw.sensors.raw_pixels import BadImage, RawPixels

F64 = NDArray[np.float64]


class Kind(Enum):
    """What a channel carries, as far as a source cares."""

    IMAGE = 1
    CALIBRATION = 2
    IMU = 3
    TRANSFORM = 4
    POSE = 5
    ODOMETRY = 6  # a pose, and velocities


KINDS = {
    "sensor_msgs/msg/Image": Kind.IMAGE,
    "sensor_msgs/msg/CompressedImage": Kind.IMAGE,
    "foxglove.CompressedImage": Kind.IMAGE,
    "foxglove.RawImage": Kind.IMAGE,
    "sensor_msgs/msg/CameraInfo": Kind.CALIBRATION,
    "foxglove.CameraCalibration": Kind.CALIBRATION,
    "sensor_msgs/msg/Imu": Kind.IMU,
    "kiteline.Imu": Kind.IMU,
    "tf2_msgs/msg/TFMessage": Kind.TRANSFORM,
    "geometry_msgs/msg/TransformStamped": Kind.TRANSFORM,
    "foxglove.FrameTransform": Kind.TRANSFORM,
    "foxglove.FrameTransforms": Kind.TRANSFORM,
    "geometry_msgs/msg/PoseStamped": Kind.POSE,
    "geometry_msgs/msg/PoseWithCovarianceStamped": Kind.POSE,
    "nav_msgs/msg/Odometry": Kind.ODOMETRY,
    "kiteline.Odometry": Kind.ODOMETRY,
    "foxglove.PoseInFrame": Kind.POSE,
}


class BadMessage(Exception):
    """One message that cannot be read. It stays inside this package: sources count it as a skip."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """CameraInfo or CameraCalibration: K, R (3,3), P (3,4), distortion D of a named model, image size in px."""

    frame_id: str
    width: int
    height: int
    model: str
    d: tuple[float, ...]
    k: F64
    r: F64
    p: F64


Transform = tuple[str, str, F64]  # parent frame, child frame, T_parent_child
ImuRow = tuple[int, tuple[float, ...]]  # t_ns; gyro x y z rad/s, accel x y z m/s^2


class MessageReader:
    """Decodes the messages of one file's channels. All methods raise BadMessage, on any bytes."""

    def __init__(self) -> None:
        self._factories = (Ros2Decoders(), ProtobufDecoders())
        self._decoders: dict[int, Callable[[bytes], Any]] = {}

    def decode(self, channel: Channel, schema: Schema | None, data: bytes) -> Any:
        """The message as an object with the fields of its schema."""
        try:
            decoder = self._decoders.get(channel.id)
            if decoder is None:
                decoder = self._decoders[channel.id] = self._find(channel, schema)
            return decoder(data)
        except BadMessage:
            raise
        except Exception as error:  # the decoders raise whatever their parsers happen to raise
            raise BadMessage(f"{channel.topic}: {type(error).__name__} {error}") from error

    def _find(self, channel: Channel, schema: Schema | None) -> Callable[[bytes], Any]:
        if channel.message_encoding == "json":
            return _json
        for factory in self._factories:
            found: Callable[[bytes], Any] | None = factory.decoder_for(channel.message_encoding, schema)
            if found is not None:
                return found
        kind = schema.encoding if schema is not None else "none"
        raise BadMessage(
            f"{channel.topic}: message encoding {channel.message_encoding!r} with schema encoding {kind!r} is unknown: "
            "expected cdr with ros2msg, protobuf or json"
        )


def _json(data: bytes) -> Any:
    return json.loads(data, object_hook=lambda value: SimpleNamespace(**value))


def stamp_ns(message: Any, otherwise_ns: int) -> int:
    """When the sensor took it; the log time where the message does not say."""
    try:
        header = getattr(message, "header", None)
        if header is not None:
            t = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
        else:
            stamp = message.timestamp
            if hasattr(stamp, "seconds"):
                t = int(stamp.seconds) * 1_000_000_000 + int(stamp.nanos)
            else:
                t = int(stamp.sec) * 1_000_000_000 + int(getattr(stamp, "nsec", 0))
    except (AttributeError, TypeError, ValueError):
        return otherwise_ns
    return t or otherwise_ns


def frame_of(message: Any) -> str:
    """The frame that a message names, without the leading slash that old tools write."""
    header = getattr(message, "header", message)
    return str(getattr(header, "frame_id", "")).lstrip("/")


def image_of(message: Any, notes: Mapping[str, str]) -> EncodedImage | RawPixels:
    """The image of a message, still coded. notes: the channel's metadata."""
    with _fields("image"):
        data = message.data if isinstance(message.data, bytes) else _bytes(message.data)
        if hasattr(message, "encoding"):
            big_endian = bool(getattr(message, "is_bigendian", False))
            width, height, step = int(message.width), int(message.height), int(message.step)
            return RawPixels(width, height, str(message.encoding), step, data, big_endian)
        scale, name = notes.get("depth_scale"), str(message.format)
        if scale:
            return EncodedImage(data, f"png/{scale}")
        if name.lower().startswith("16uc1"):
            if "compresseddepth" in name.lower():
                data = data[12:]  # image_transport puts a header of its own before the PNG
            return EncodedImage(data, "png/1000")
        try:
            return EncodedImage(data, sniff(data))
        except BadImage:
            return EncodedImage(data, name)


def is_depth(image: EncodedImage | RawPixels) -> bool:
    """Whether an image holds distances."""
    return image.is_depth if isinstance(image, RawPixels) else "/" in image.format


def calibration_of(message: Any) -> Calibration:
    """The calibration of a camera, binning and region of interest applied."""
    with _fields("calibration"):
        lower = hasattr(message, "k")
        k, r, p = (np.array(getattr(message, name if lower else name.upper()), np.float64) for name in ("k", "r", "p"))
        d = tuple(float(v) for v in (message.d if lower else message.D))
        k = k.reshape(3, 3)
        r = r.reshape(3, 3) if r.size == 9 and r.any() else np.eye(3)
        p = p.reshape(3, 4) if p.size == 12 and p.any() else np.hstack([k, np.zeros((3, 1))])
        width, height = int(message.width), int(message.height)
        roi = getattr(message, "roi", None)
        if roi is not None and roi.width and roi.height:
            for m in (k, p):
                m[0, 2] -= roi.x_offset
                m[1, 2] -= roi.y_offset
            width, height = int(roi.width), int(roi.height)
        bin_x, bin_y = max(1, getattr(message, "binning_x", 1)), max(1, getattr(message, "binning_y", 1))
        for m in (k, p):
            m[0] /= bin_x
            m[1] /= bin_y
        return Calibration(
            frame_of(message), width // bin_x, height // bin_y, str(message.distortion_model), d, k, r, p
        )


def imu_of(message: Any, otherwise_ns: int) -> list[ImuRow]:
    """The inertial samples of a message."""
    with _fields("imu"):
        if hasattr(message, "t_ns"):
            gyro, accel = message.gyro, message.accel
            rows = [(*gyro[3 * i : 3 * i + 3], *accel[3 * i : 3 * i + 3]) for i in range(len(message.t_ns))]
            return list(zip(message.t_ns, rows, strict=True))
        w, a = message.angular_velocity, message.linear_acceleration
        return [(stamp_ns(message, otherwise_ns), (w.x, w.y, w.z, a.x, a.y, a.z))]


def odometry_of(message: Any, otherwise_ns: int) -> OdometryBatch:
    """The velocities of a message, in the axes of the frame that it names (`child_of`); our own are the body's."""
    with _fields("odometry"):
        if hasattr(message, "velocity_cov"):
            return read_odometry(message)
        v, w = message.twist.twist.linear, message.twist.twist.angular
        diagonal = np.diagonal(np.array(message.twist.covariance, np.float64).reshape(6, 6))
        return OdometryBatch(
            np.array([stamp_ns(message, otherwise_ns)], np.int64),
            np.array([[v.x, v.y, v.z]], np.float64),
            np.array([[w.x, w.y, w.z]], np.float64),
            stated_variances(diagonal[:3], VELOCITY_SIGMA_M_S)[None],
            stated_variances(diagonal[3:], RATE_SIGMA_RAD_S)[None],
        )


def child_of(message: Any) -> str:
    """The frame in which an odometry message gives its velocities."""
    return str(getattr(message, "child_frame_id", "")).lstrip("/")


def transforms_of(message: Any) -> list[Transform]:
    """Where frames lie in others."""
    with _fields("transform"):
        out: list[Transform] = []
        for item in getattr(message, "transforms", None) or [message]:
            if hasattr(item, "parent_frame_id"):
                parent, child, t, q = item.parent_frame_id, item.child_frame_id, item.translation, item.rotation
            else:
                parent, child = item.header.frame_id, item.child_frame_id
                t, q = item.transform.translation, item.transform.rotation
            out.append((str(parent).lstrip("/"), str(child).lstrip("/"), _pose(t, q)))
        return out


def pose_of(message: Any) -> F64:
    """T_w_b (4,4) of a pose message."""
    with _fields("pose"):
        pose = getattr(message.pose, "pose", message.pose)
        return _pose(pose.position, pose.orientation)


def _pose(t: Any, q: Any) -> F64:
    quaternion = np.array([q.w, q.x, q.y, q.z], np.float64)
    position = np.array([t.x, t.y, t.z], np.float64)
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all() and quaternion.any()):
        raise BadMessage(f"no pose: position {position}, quaternion {quaternion}")
    return se3.from_quaternion(quaternion, position)


def _bytes(value: Any) -> bytes:
    return base64.b64decode(value, validate=True) if isinstance(value, str) else bytes(value)


class _fields:
    """Turns what a message with unexpected fields makes Python raise into BadMessage."""

    def __init__(self, what: str) -> None:
        self._what = what

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, (AttributeError, TypeError, ValueError, KeyError, IndexError, struct.error, McapError)):
            raise BadMessage(f"{self._what} message without the expected fields ({error})") from error

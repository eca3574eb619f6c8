"""Decodes messages of ROS 2 (CDR) and Foxglove (protobuf, JSON) and converts them to our types."""

import base64
import json
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders

from kiteline_core.arrays import F64
from kiteline_core.frame import EncodedImage, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_hw.logs.mcap_log_read import read_odometry
from kiteline_hw.sensors.images import detect_format
from kiteline_hw.sensors.odometry_buffer import RATE_SIGMA_RAD_S, VELOCITY_SIGMA_M_S, reported_covariance
from kiteline_hw.sensors.raw_pixels import BadImage, RawPixels
from kiteline_hw.sources.bags.ros2_samples import fast_decoder

_LOOKED_AT = 20  # messages of a channel, of which the first stamp that is not 0 is compared with its log time
_OTHER_CLOCK_NS = 3_600_000_000_000  # ns between stamp and log time, from which they are of two clocks


class ChannelKind(Enum):
    """What a channel carries."""

    IMAGE = 1
    CALIBRATION = 2
    IMU = 3
    TRANSFORM = 4
    POSE = 5
    ODOMETRY = 6  # a pose and velocities


KINDS = {
    "sensor_msgs/msg/Image": ChannelKind.IMAGE,
    "sensor_msgs/msg/CompressedImage": ChannelKind.IMAGE,
    "foxglove.CompressedImage": ChannelKind.IMAGE,
    "foxglove.RawImage": ChannelKind.IMAGE,
    "sensor_msgs/msg/CameraInfo": ChannelKind.CALIBRATION,
    "foxglove.CameraCalibration": ChannelKind.CALIBRATION,
    "sensor_msgs/msg/Imu": ChannelKind.IMU,
    "kiteline.Imu": ChannelKind.IMU,
    "tf2_msgs/msg/TFMessage": ChannelKind.TRANSFORM,
    "geometry_msgs/msg/TransformStamped": ChannelKind.TRANSFORM,
    "foxglove.FrameTransform": ChannelKind.TRANSFORM,
    "foxglove.FrameTransforms": ChannelKind.TRANSFORM,
    "geometry_msgs/msg/PoseStamped": ChannelKind.POSE,
    "geometry_msgs/msg/PoseWithCovarianceStamped": ChannelKind.POSE,
    "nav_msgs/msg/Odometry": ChannelKind.ODOMETRY,
    "kiteline.Odometry": ChannelKind.ODOMETRY,
    "foxglove.PoseInFrame": ChannelKind.POSE,
}


class BadMessage(Exception):
    """One message that cannot be read. Raised only inside this package: sources count it as skipped."""


@dataclass(frozen=True, slots=True)
class CameraCalibration:
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


class MessageDecoder:
    """Decodes the messages of one file's channels. Raises BadMessage, and nothing else, on any bytes."""

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
        except Exception as error:  # the decoders document no exceptions
            raise BadMessage(f"{channel.topic}: {type(error).__name__} {error}") from error

    def _find(self, channel: Channel, schema: Schema | None) -> Callable[[bytes], Any]:
        if channel.message_encoding == "json":
            return _json
        for factory in self._factories:
            found: Callable[[bytes], Any] | None = factory.decoder_for(channel.message_encoding, schema)
            if found is not None:
                return fast_decoder(schema, found)
        kind = schema.encoding if schema is not None else "none"
        raise BadMessage(
            f"{channel.topic}: message encoding {channel.message_encoding!r} with schema encoding {kind!r} is unknown: "
            "expected cdr with ros2msg, protobuf or json"
        )


def _json(data: bytes) -> Any:
    return json.loads(data, object_hook=lambda value: SimpleNamespace(**value))


def read_stamp(message: Any, otherwise_ns: int) -> int:
    """Capture time in ns; `otherwise_ns` if the message has none."""
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


def fits_log_clock(messages: Iterable[tuple[int, int]]) -> bool:
    """True if the log time may stand in for a stamp of 0. messages: stamp and log time in ns of a channel.

    In simulated time, which begins at 0, the recorder's clock is another one, and 0 is a time.
    """
    stamped = next(((t, log_ns) for t, log_ns in islice(messages, _LOOKED_AT) if t), None)
    return stamped is None or abs(stamped[1] - stamped[0]) < _OTHER_CLOCK_NS


def read_frame_id(message: Any) -> str:
    """The frame_id, without the leading slash that old tools write."""
    header = getattr(message, "header", message)
    return str(getattr(header, "frame_id", "")).lstrip("/")


def read_image(message: Any, metadata: Mapping[str, str]) -> EncodedImage | RawPixels:
    """The image, still encoded. metadata: of the channel; holds the scale of a depth image in our logs."""
    with _reading("image"):
        data = message.data if isinstance(message.data, bytes) else _bytes(message.data)
        if hasattr(message, "encoding"):
            big_endian = bool(getattr(message, "is_bigendian", False))
            width, height, step = int(message.width), int(message.height), int(message.step)
            return RawPixels(width, height, str(message.encoding), step, data, big_endian)
        scale, name = metadata.get("depth_scale"), str(message.format)
        if scale:
            return EncodedImage(data, f"png/{scale}")
        if name.lower().startswith("16uc1"):
            if "compresseddepth" in name.lower():
                data = data[12:]  # image_transport writes a header of its own before the PNG
            return EncodedImage(data, "png/1000")
        try:
            return EncodedImage(data, detect_format(data))
        except BadImage:
            return EncodedImage(data, name)


def is_depth(image: EncodedImage | RawPixels) -> bool:
    """True if an image holds distances."""
    return image.is_depth if isinstance(image, RawPixels) else "/" in image.format


def read_calibration(message: Any) -> CameraCalibration:
    """The calibration of a camera, binning and region of interest applied."""
    with _reading("calibration"):
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
        return CameraCalibration(
            read_frame_id(message), width // bin_x, height // bin_y, str(message.distortion_model), d, k, r, p
        )


def read_imu(message: Any, otherwise_ns: int) -> list[ImuRow]:
    """The inertial samples of a message."""
    with _reading("imu"):
        if hasattr(message, "t_ns"):
            gyro, accel = message.gyro, message.accel
            rows = [(*gyro[3 * i : 3 * i + 3], *accel[3 * i : 3 * i + 3]) for i in range(len(message.t_ns))]
            return list(zip(message.t_ns, rows, strict=True))
        w, a = message.angular_velocity, message.linear_acceleration
        return [(read_stamp(message, otherwise_ns), (w.x, w.y, w.z, a.x, a.y, a.z))]


def read_velocities(message: Any, otherwise_ns: int) -> OdometryBatch:
    """The velocities, in the frame that the message names (`read_child_frame`); in our own logs in the body frame."""
    with _reading("odometry"):
        if hasattr(message, "velocity_cov"):
            return read_odometry(message)
        v, w = message.twist.twist.linear, message.twist.twist.angular
        diagonal = np.diagonal(np.array(message.twist.covariance, np.float64).reshape(6, 6))
        return OdometryBatch(
            np.array([read_stamp(message, otherwise_ns)], np.int64),
            np.array([[v.x, v.y, v.z]], np.float64),
            np.array([[w.x, w.y, w.z]], np.float64),
            reported_covariance(diagonal[:3], VELOCITY_SIGMA_M_S)[None],
            reported_covariance(diagonal[3:], RATE_SIGMA_RAD_S)[None],
        )


def read_child_frame(message: Any) -> str:
    """The frame in which an odometry message gives its velocities."""
    return str(getattr(message, "child_frame_id", "")).lstrip("/")


def read_transforms(message: Any) -> list[Transform]:
    """The frame transforms of a message."""
    with _reading("transform"):
        out: list[Transform] = []
        for item in getattr(message, "transforms", None) or [message]:
            if hasattr(item, "parent_frame_id"):
                parent, child, t, q = item.parent_frame_id, item.child_frame_id, item.translation, item.rotation
            else:
                parent, child = item.header.frame_id, item.child_frame_id
                t, q = item.transform.translation, item.transform.rotation
            out.append((str(parent).lstrip("/"), str(child).lstrip("/"), _pose(t, q)))
        return out


def read_pose(message: Any) -> F64:
    """T_w_b (4,4) of a pose message."""
    with _reading("pose"):
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


class _reading:
    """Converts the exceptions caused by missing or malformed fields to BadMessage."""

    def __init__(self, what: str) -> None:
        self._what = what

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, (AttributeError, TypeError, ValueError, KeyError, IndexError, struct.error, McapError)):
            raise BadMessage(f"{self._what} message without the expected fields ({error})") from error

"""Reading logs back: messages in the order in which they were written, decoded by what their topic holds."""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from kiteline_core.arrays import F64
from kiteline_core.errors import INPUT_FAULTS
from kiteline_core.frame import EncodedImage, Frame, ImuBatch, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_hw.logs import mcap_schemas as schemas
from kiteline_hw.logs.mcap_file import McapFile
from kiteline_hw.ports import SourceError
from kiteline_hw.sensors.images import decode_depth, decode_grey
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.system.closing import Closing


@dataclass(frozen=True, slots=True)
class LogMessage:
    """A logged message, decoded by the method for its type. Raises SourceError if the type differs."""

    topic: str
    t_ns: int
    schema: str
    data: bytes
    notes: Mapping[str, str]

    def blob(self) -> bytes:
        """The logged bytes."""
        data: bytes = self._parse(schemas.Blob).data
        return data

    def json(self) -> Any:
        """The logged value; of named fields an object, with arrays as lists."""
        try:
            return self._fields() if self.schema == "kiteline.Fields" else json.loads(self.data)
        except (ValueError, *INPUT_FAULTS) as error:
            raise SourceError(f"{self.topic} at {self.t_ns} ns holds no JSON") from error

    def _fields(self) -> dict[str, Any]:
        """Raises ValueError."""
        message = self._parse(schemas.Fields)
        named, numbers, at = json.loads(message.text), list(message.numbers), 0
        if not isinstance(named, dict) or not all(isinstance(named.get(key), dict) for key in ("fields", "arrays")):
            raise ValueError("no named fields")
        values: dict[str, Any] = dict(named["fields"])
        for name, size in named["arrays"].items():
            if not isinstance(size, int) or not 0 <= size <= len(numbers) - at:
                raise ValueError(f"{name} is cut short")
            values[name] = numbers[at : at + size]
            at += size
        return values

    def image(self) -> EncodedImage:
        """The encoded image; the format of a depth image includes its scale."""
        message = self._parse(schemas.CompressedImage)
        scale = self.notes.get("depth_scale")
        return EncodedImage(message.data, f"{message.format}/{scale}" if scale else message.format)

    def imu(self) -> ImuBatch:
        """The batch of samples."""
        message = self._parse(schemas.Imu)
        gyro, accel = (np.array(rows, np.float64).reshape(-1, 3) for rows in (message.gyro, message.accel))
        return ImuBatch(np.array(message.t_ns, np.int64), gyro, accel)

    def odometry(self) -> OdometryBatch:
        """The batch of velocities."""
        try:
            return read_odometry(self._parse(schemas.Odometry))
        except ValueError as error:
            raise SourceError(f"{self.topic} at {self.t_ns} ns: damaged odometry ({error})") from error

    def pose(self) -> F64:
        """The pose (4,4)."""
        message = self._parse(schemas.PoseInFrame)
        return _read_pose(message.pose.position, message.pose.orientation)

    def transform(self) -> tuple[str, str, F64]:
        """Parent frame, child frame, T_parent_child (4,4)."""
        m = self._parse(schemas.FrameTransform)
        return m.parent_frame_id, m.child_frame_id, _read_pose(m.translation, m.rotation)

    def _parse(self, message_class: Any) -> Any:
        expected = message_class.DESCRIPTOR.full_name
        if self.schema != expected:
            raise SourceError(f"{self.topic} holds {self.schema}, not {expected}")
        message = message_class()
        try:
            message.ParseFromString(self.data)
        except DecodeError as error:
            raise SourceError(f"{self.topic} at {self.t_ns} ns: damaged {expected}") from error
        return message


class LogReader(Closing):
    """Reads a log, also a cut one. Raises SourceError if it is no MCAP file."""

    def __init__(self, path: Path | str) -> None:
        self.file = McapFile(Path(path))
        self.cut = self.file.cut
        self.metadata: dict[str, str] = {}
        for record in self.file.metadata:
            if record.name == "kiteline":
                self.metadata = dict(record.metadata)
        self.topics = {c.topic: self.file.counts.get(i, 0) for i, c in self.file.channels.items()}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """Messages of the topics (None: all), in the order of writing."""
        channels = self.file.channels
        wanted = None if topics is None else [i for i, c in channels.items() if c.topic in topics]
        for raw in self.file.messages(wanted, ordered=False):
            channel = channels[raw.channel]
            schema = self.file.schema_of(raw.channel)
            name = schema.name if schema is not None else ""
            yield LogMessage(channel.topic, raw.log_ns, name, raw.data, channel.metadata)

    def close(self) -> None:
        """Nothing is held open between two readings."""


def read_frame(images: Sequence[EncodedImage], t_ns: int, *, has_depth: bool = False) -> Frame:
    """The Frame of logged images: left, right if there is one, depth last if has_depth. Raises SourceError."""
    try:
        left, _ = decode_grey(images[0])
        depth = decode_depth(images[-1])[0] if has_depth and len(images) > 1 else None
        right = decode_grey(images[1])[0] if len(images) - (depth is not None) > 1 else None
    except BadImage as error:
        raise SourceError(f"logged image at {t_ns} ns cannot be decoded: {error}") from error
    return Frame(t_ns, left, right, depth, tuple(images))


def read_odometry(message: Any) -> OdometryBatch:
    """The batch of a kiteline.Odometry message. Raises ValueError if its fields are inconsistent."""
    n = len(message.t_ns)
    velocity, rate = (np.array(v, np.float64).reshape(n, 3) for v in (message.velocity, message.rate))
    covs = (np.array(v, np.float64).reshape(n, 3, 3) for v in (message.velocity_cov, message.rate_cov))
    return OdometryBatch(np.array(message.t_ns, np.int64), velocity, rate, *covs)


def _read_pose(position: Any, orientation: Any) -> F64:
    q = np.array([orientation.w, orientation.x, orientation.y, orientation.z])
    return se3.from_quaternion(q, np.array([position.x, position.y, position.z]))

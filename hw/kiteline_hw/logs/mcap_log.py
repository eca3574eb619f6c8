"""Writes logs: one MCAP file per process, readable by Foxglove and Lichtblick, recoverable if cut, reproducible.

Write::

    log = LogWriter(path, {"role": "agent", "agent": "0"})      # metadata record "kiteline"
    log.rig(t_ns, source.rig, source.imu)                       # once, so that the log opens as a source again
    log.frame(frame)                                            # /left/image, /right/image, /depth/image
    log.imu(IMU, t_ns, batch);  log.odometer(ODOMETER, t_ns, batch)
    log.blob("/packets/in", t_ns, packet)                       # opaque bytes
    log.json("/events", t_ns, {"reset": 1});  log.fields("/estimate", t_ns, {"quality": 90, "T_o_b": T_o_b})
    log.transform("/tf", t_ns, "map", "body", T_map_body);  log.pose("/pose", t_ns, "world", T_w_b)
    log.poses("/path", t_ns, "world", T_w_b_all);  log.grid(...);  log.text("/log", t_ns, "info", "…")
    log.close()                                                 # also a context manager

Log times are handed in and nothing here reads a clock, so equal calls give equal bytes. Chunks are written at 64 KiB
and after one second of flight time, so that a cut file loses little. Raw images are encoded in a thread of its own;
messages keep their order and wait for the images before them.

Read::

    with LogReader(path) as log:
        log.metadata["role"];  log.topics;  log.cut             # cut: None, or where a cut file ends
        for m in log.messages(["/packets/in", "/left/image"]):  # in the order of writing
            m.topic, m.t_ns;  m.blob() | m.json() | m.image() | m.imu() | m.odometry() | m.pose() | m.transform()

`read_frame(images, t_ns, has_depth)` decodes logged images to the original Frame. A log is also a source:
`open_source("mcap:agent0/log.mcap")` yields the same Frames, ImuBatches and OdometryBatches.
"""

import json
from collections.abc import Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_core.arrays import F64, I8
from kiteline_core.frame import EncodedImage, Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.logs import mcap_schemas as schemas
from kiteline_hw.logs.image_encoder import ENCODE_ALL, ImageEncoder
from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.log_parts import path_of_part
from kiteline_hw.logs.mcap_log_read import LogMessage, LogReader, read_frame
from kiteline_hw.logs.mcap_write import CHUNK_BYTES, McapWriter
from kiteline_hw.logs.rig_json import LENS_NAMES, rig_to_json
from kiteline_hw.logs.whole_file import BesideFile, FileToCome, WholeFile
from kiteline_hw.ports import SourceError
from kiteline_hw.system.closing import Closing

__all__ = [
    "DEPTH", "GROUND_TRUTH", "IMU", "LEFT", "ODOMETER", "RIG", "RIGHT", "LogMessage", "LogReader", "LogWriter",
    "read_frame",
]  # fmt: skip

LEFT, RIGHT, DEPTH = "/left/image", "/right/image", "/depth/image"
IMU, ODOMETER, RIG, GROUND_TRUTH = "/imu", "/odometer", "/rig", "/ground_truth"

FLUSH_NS = 1_000_000_000  # ns of flight time after which an unfinished chunk is written
LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "fatal": 5}
_JSON = json.JSONEncoder(separators=(",", ":"), allow_nan=False)
_NO_NOTES: Mapping[str, str] = {}


class LogWriter(Closing):
    """Writes one log. Raises SourceError if the file cannot be created; a disk that is full later only loses messages.

    budget: limits the logs of the folder; at a part of it a new file NAME_1.mcap, NAME_2.mcap… begins, with the next
    message on `part_topic`, and the oldest logs are deleted. dropped: messages not written. why: of the first of them;
    "" if none was lost. encoder: of raw images; it is closed with the log. beside: the file is written by a thread, so
    that no caller waits for a disk that stalls.
    """

    def __init__(
        self, path: Path | str, metadata: Mapping[str, str], *, budget: LogBudget | None = None,
        part_topic: str | None = None, encoder: ImageEncoder | None = None, beside: bool = False,
    ) -> None:  # fmt: skip
        self.path = Path(path)
        self.dropped = 0
        self.why = ""
        self._encoder = ImageEncoder(ENCODE_ALL) if encoder is None else encoder
        self._metadata = dict(metadata)
        self._budget, self._part_topic = budget, part_topic
        self._part = 0
        self._beside = beside
        self._ended: list[BesideFile] = []  # earlier parts for which the disk may not have had the time yet
        self._coming: FileToCome | None = None  # the next part, while it is created
        self._rig: tuple[CameraRig, ImuCalibration | None] | None = None
        if budget is not None:
            budget.make_room()
        try:
            self._begin(self.path, BesideFile(self.path) if beside else WholeFile(self.path))
        except OSError as error:
            raise SourceError(f"{self.path}: cannot write the log: {error.strerror}") from error

    # Data of a source

    def rig(self, t_ns: int, rig: CameraRig, imu: ImuCalibration | None) -> None:
        """Calibration: exact on /rig (JSON), and as Foxglove CameraCalibration and FrameTransforms for viewers."""
        self._rig = rig, imu
        self.json(RIG, t_ns, rig_to_json(rig, imu), "kiteline.Rig")
        self.calibration("/left/calibration", t_ns, rig.left, "left", 0.0)
        self.transform("/tf_static", t_ns, "body", "left", rig.T_b_c)
        if rig.right is not None and rig.T_c_r is not None:
            self.calibration("/right/calibration", t_ns, rig.right, "right", float(rig.T_c_r[0, 3]))
            self.transform("/tf_static", t_ns, "left", "right", rig.T_c_r)

    def frame(self, frame: Frame) -> None:
        """The images of a frame, as encoded in the source; raw ones are encoded as PNG, in another thread."""
        t = frame.t_ns
        kept: list[EncodedImage | Future[EncodedImage]] = [*frame.encoded] or self._encoder.encode(frame)
        self._image(LEFT, t, kept[0], "left")
        if frame.right is not None:
            self._image(RIGHT, t, kept[1], "right")
        if frame.depth_m is not None:
            self._image(DEPTH, t, kept[-1], "left")

    def image(self, topic: str, t_ns: int, image: EncodedImage, frame_id: str) -> None:
        """An encoded image. The scale of a depth format such as "png/5000" is stored in the channel's metadata."""
        kind, _, scale = image.format.partition("/")
        message = schemas.CompressedImage(frame_id=frame_id, format=kind)
        self._stamp(message, t_ns)
        notes = {"depth_scale": scale} if scale else {}
        self._add(topic, t_ns, message, notes, schemas.bytes_field(schemas.CompressedImage, "data", image.data))

    def _image(self, topic: str, t_ns: int, image: EncodedImage | Future[EncodedImage], frame_id: str) -> None:
        if isinstance(image, EncodedImage):
            self.image(topic, t_ns, image, frame_id)
        else:
            self._encoder.then(image, lambda done: self.image(topic, t_ns, done, frame_id))

    def imu(self, topic: str, t_ns: int, batch: ImuBatch) -> None:
        """A batch of inertial samples."""
        message = schemas.Imu(
            t_ns=batch.t_ns.tolist(), gyro=batch.gyro.ravel().tolist(), accel=batch.accel.ravel().tolist()
        )
        self._add(topic, t_ns, message)

    def odometer(self, topic: str, t_ns: int, batch: OdometryBatch) -> None:
        """A batch of velocities."""
        message = schemas.Odometry(
            t_ns=batch.t_ns.tolist(), velocity=batch.velocity.ravel().tolist(), rate=batch.rate.ravel().tolist(),
            velocity_cov=batch.velocity_cov.ravel().tolist(), rate_cov=batch.rate_cov.ravel().tolist(),
        )  # fmt: skip
        self._add(topic, t_ns, message)

    def ground_truth(self, truth: Trajectory) -> None:
        """All poses of a known trajectory, each at its own time."""
        for t, pose in zip(truth.t_ns, truth.T_w_b, strict=True):
            self.pose(GROUND_TRUTH, int(t), "world", pose)

    # Messages for viewers

    def calibration(self, topic: str, t_ns: int, camera: CameraModel, frame_id: str, baseline_m: float) -> None:
        """Camera intrinsics. baseline_m: distance of this camera to the right of the left one."""
        k = camera.matrix()
        p = np.hstack([k, [[-camera.fx * baseline_m], [0.0], [0.0]]])
        message = schemas.CameraCalibration(
            frame_id=frame_id, width=camera.width, height=camera.height, K=k.ravel(), R=np.eye(3).ravel(), P=p.ravel(),
            distortion_model=LENS_NAMES[camera.lens], D=camera.distortion,
        )  # fmt: skip
        self._stamp(message, t_ns)
        self._add(topic, t_ns, message)

    def transform(self, topic: str, t_ns: int, parent: str, child: str, t_parent_child: F64) -> None:
        """The pose of frame `child` in frame `parent`."""
        message = schemas.FrameTransform(parent_frame_id=parent, child_frame_id=child)
        self._stamp(message, t_ns)
        _fill_pose(message.translation, message.rotation, t_parent_child)
        self._add(topic, t_ns, message)

    def pose(self, topic: str, t_ns: int, frame_id: str, pose: F64) -> None:
        """A pose (4,4) in a frame."""
        message = schemas.PoseInFrame(frame_id=frame_id)
        self._stamp(message, t_ns)
        _fill_pose(message.pose.position, message.pose.orientation, pose)
        self._add(topic, t_ns, message)

    def poses(self, topic: str, t_ns: int, frame_id: str, poses: F64) -> None:
        """Poses (n,4,4) in a frame."""
        message = schemas.PosesInFrame(frame_id=frame_id)
        self._stamp(message, t_ns)
        for pose in poses:
            item = message.poses.add()
            _fill_pose(item.position, item.orientation, pose)
        self._add(topic, t_ns, message)

    def grid(
        self, topic: str, t_ns: int, frame_id: str, cells: I8, cell_m: float,
        corner_m: tuple[float, float],
    ) -> None:  # fmt: skip
        """Occupancy (rows, columns) int8, 0..100 percent, -1 unknown; row 0 is the lowest y, corner_m lower left."""
        message = schemas.Grid(frame_id=frame_id, column_count=cells.shape[1], row_stride=cells.shape[1], cell_stride=1)
        self._stamp(message, t_ns)
        message.pose.position.x, message.pose.position.y = corner_m
        message.pose.orientation.w = 1.0
        message.cell_size.x = message.cell_size.y = cell_m
        message.fields.add(name="occupancy", offset=0, type=2)  # INT8
        message.data = np.ascontiguousarray(cells).tobytes()
        self._add(topic, t_ns, message)

    def text(self, topic: str, t_ns: int, level: str, text: str, name: str = "kiteline") -> None:
        """A line of text; level: debug, info, warning, error, fatal."""
        message = schemas.Log(level=LEVELS[level], message=text, name=name)  # type: ignore[arg-type]
        self._stamp(message, t_ns)
        self._add(topic, t_ns, message)

    # Data for replay

    def blob(self, topic: str, t_ns: int, data: bytes) -> None:
        """Opaque bytes."""
        pieces = schemas.bytes_field(schemas.Blob, "data", data) if data else ()
        self._write(topic, t_ns, schemas.Blob, pieces, _NO_NOTES)

    def json(self, topic: str, t_ns: int, value: object, schema: str = "kiteline.Json") -> None:
        """A JSON value; keys keep their order."""
        self._write(topic, t_ns, schema, (_JSON.encode(value).encode(),), _NO_NOTES)

    def fields(self, topic: str, t_ns: int, values: Mapping[str, object]) -> None:
        """Named JSON values and float64 arrays, which are written as they are: their text would cost ten times as much.

        Read as JSON, an array is the list of its numbers.
        """
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        plain = {name: value for name, value in values.items() if name not in arrays}
        text = _JSON.encode({"fields": plain, "arrays": {name: array.size for name, array in arrays.items()}})
        pieces: tuple[bytes, ...] = schemas.bytes_field(schemas.Fields, "text", text.encode())
        numbers = b"".join([np.asarray(array, np.float64).tobytes() for array in arrays.values()])
        if numbers:
            pieces += schemas.bytes_field(schemas.Fields, "numbers", numbers)
        self._write(topic, t_ns, schemas.Fields, pieces, _NO_NOTES)

    @property
    def waits_for(self) -> str:
        """Why the disk takes nothing at present, while nothing is lost yet; "" if it does, and always if not beside."""
        parts = [*self._ended, *([self._stream] if isinstance(self._stream, BesideFile) else [])]
        return next((part.waits_for for part in parts if part.waits_for), "")

    def flush(self) -> None:
        """Pass all logged data to the operating system, or the thread beside; waits for images being encoded."""
        self._encoder.drain()
        try:
            self._writer.flush()
        except OSError as error:
            self._count_lost(error)

    def close(self) -> None:
        """Finish the file with its index."""
        self._encoder.close()
        self._finish()

    def _finish(self) -> None:
        if self._stream.closed:
            return
        try:
            self._writer.finish()
        except OSError as error:
            self._count_lost(error)
        finally:
            self._end(self._stream)
        BesideFile.close_all(self._ended)
        for stream in self._ended:
            if stream.unwritten:
                self._count_lost(stream.fault, stream.unwritten)
        if self._coming is not None and not self.why:  # a disk that does not answer is not awaited once more
            self._coming.remove()

    def _end(self, stream: WholeFile | BesideFile) -> None:
        """End a part without waiting for the disk."""
        stream.end()
        self._ended = [part for part in self._ended if part.unwritten]
        if isinstance(stream, BesideFile):
            self._ended.append(stream)

    def _count_lost(self, error: OSError, chunks: int = 1) -> None:
        """Count what the disk did not take. chunks: of a message each at least."""
        self.why = self.why or error.strerror or str(error)
        self.dropped += max(chunks, self._writer.lost)
        self._writer.lost = 0
        if self._budget is not None:
            self._budget.make_room_beside(self._path)

    def _begin(self, path: Path, stream: WholeFile | BesideFile) -> None:
        """Write to a new file from now on."""
        self._path, self._stream = path, stream
        self._writer = McapWriter(self._stream, CHUNK_BYTES, "kiteline")
        self._writer.add_metadata("kiteline", {**self._metadata, **({"part": str(self._part)} if self._part else {})})
        self._channels: dict[str, tuple[int, object]] = {}  # number and kind, by topic
        self._schemas: dict[str, int] = {}
        self._flushed_ns: int | None = None
        self._bytes = 0

    def _stamp(self, message: Any, t_ns: int) -> None:
        message.timestamp.seconds, message.timestamp.nanos = divmod(t_ns, 1_000_000_000)

    def _add(
        self, topic: str, t_ns: int, message: Any, notes: Mapping[str, str] = _NO_NOTES, rest: tuple[bytes, ...] = ()
    ) -> None:
        self._write(topic, t_ns, type(message), (message.SerializeToString(), *rest), notes)

    def _write(self, topic: str, t_ns: int, kind: object, pieces: tuple[bytes, ...], notes: Mapping[str, str]) -> None:
        """Write a message, or keep it while images before it are being encoded. kind: as in `_register`."""
        if self._encoder.waiting:
            self._encoder.then(None, lambda _: self._write_now(topic, t_ns, kind, pieces, notes))
            self._encoder.drain(wait=False)
        else:
            self._write_now(topic, t_ns, kind, pieces, notes)

    def _write_now(
        self, topic: str, t_ns: int, kind: object, pieces: tuple[bytes, ...], notes: Mapping[str, str]
    ) -> None:
        size = sum(map(len, pieces)) + 64
        if self._budget is not None and self._bytes + size > self._budget.part_bytes:
            self._begin_part(self._budget, topic, t_ns)
        try:
            known = self._channels.get(topic)
            if known is None:
                known = self._channels[topic] = self._register(topic, kind, notes), kind
            elif known[1] is not kind and known[1] != kind:
                raise ValueError(f"topic {topic} holds {_name(known[1])}, not {_name(kind)}")
            self._writer.add_message(known[0], t_ns, pieces)
            self._bytes += size
            if self._flushed_ns is None:
                self._flushed_ns = t_ns
            elif abs(t_ns - self._flushed_ns) >= FLUSH_NS:
                self._flushed_ns = t_ns
                self._writer.flush()
                if self._budget is not None and self.waits_for:
                    self._budget.make_room_beside(self._path)
        except OSError as error:
            self._count_lost(error)

    def _register(self, topic: str, kind: object, notes: Mapping[str, str]) -> int:
        """The number of a new channel. kind: a protobuf message's class, or the name of a JSON schema."""
        name, text = _name(kind), isinstance(kind, str)
        if name not in self._schemas:
            data = b'{"type":"object"}' if text else schemas.schema_data(kind)
            self._schemas[name] = self._writer.register_schema(name, "jsonschema" if text else "protobuf", data)
        return self._writer.register_channel(topic, "json" if text else "protobuf", self._schemas[name], notes)

    def _begin_part(self, budget: LogBudget, topic: str, t_ns: int) -> None:
        """Go on in another file, if one can begin with this message and can be made; else in this one."""
        if not self._bytes or (self._part_topic is not None and topic != self._part_topic):
            return
        path = path_of_part(self.path, self._part + 1)
        created = self._created(path)
        if created is None:
            return
        writer, stream = self._writer, self._stream
        self._part += 1
        self._begin(path, created)
        try:
            writer.finish()
        except OSError as error:
            self._count_lost(error)
        finally:
            self._end(stream)
        budget.make_room_beside(self._path)
        if self._rig is not None:
            self.rig(t_ns, *self._rig)

    def _created(self, path: Path) -> WholeFile | BesideFile | None:
        """A new file; None if it cannot be created, or is not yet: beside the caller, that is asked again."""
        if not self._beside:
            try:
                return WholeFile(path)
            except OSError:
                return None
        coming = self._coming = self._coming or FileToCome(path)
        if not coming.done:
            return None
        self._coming = None
        return coming.take()


def _name(kind: Any) -> str:
    """The name of a kind of message."""
    return kind if isinstance(kind, str) else str(kind.DESCRIPTOR.full_name)


def _fill_pose(position: Any, orientation: Any, pose: F64) -> None:
    position.x, position.y, position.z = pose[:3, 3].tolist()
    orientation.w, orientation.x, orientation.y, orientation.z = se3.quaternion_numbers(pose[:3, :3])

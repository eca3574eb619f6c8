"""Recordings of messages as sources: ROS 2 bags, Foxglove recordings, kiteline logs (which yield identical frames)."""

import heapq
import json
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from kiteline_core import odometry
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, OdometryBatch, Trajectory
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.logs.mcap_file import RawMessage
from kiteline_hw.logs.mcap_log import DEPTH, GROUND_TRUTH, IMU, LEFT, ODOMETER, RIG, RIGHT
from kiteline_hw.logs.rig_json import rig_from_json
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.frames import (
    DEPTH_TOLERANCE_NS,
    PAIR_TOLERANCE_NS,
    EncodedFrame,
    decode_frames,
    pair_by_time,
)
from kiteline_hw.sensors.images import ImageRef, decode_grey
from kiteline_hw.sensors.imu_buffer import ImuStream, NoImu
from kiteline_hw.sensors.odometry_buffer import OdometerStream, insert_before_frames
from kiteline_hw.sensors.raw_pixels import BadImage, RawPixels
from kiteline_hw.sensors.sensor_bits import SensorBits, bits_of_grey
from kiteline_hw.sensors.split_imu import ImuJoiner, join_imu
from kiteline_hw.sources.bags.bag_files import Bag, open_bag, unpacked
from kiteline_hw.sources.bags.imu_topics import ImuChoice, ImuTopic, accelerations_in_g, choose_imu, what_is_measured
from kiteline_hw.sources.mcap_messages import (
    KINDS,
    BadMessage,
    CameraCalibration,
    ChannelKind,
    MessageDecoder,
    Transform,
    fits_log_clock,
    is_depth,
    read_calibration,
    read_child_frame,
    read_frame_id,
    read_image,
    read_imu,
    read_pose,
    read_stamp,
    read_transforms,
    read_velocities,
)
from kiteline_hw.sources.mcap_rig import ImageTopic, Selection, TransformTree, select_given_rig, select_rig
from kiteline_hw.sources.recording import sorted_trajectory

_REORDER_NS = 200_000_000  # ns that a message is held back for older ones recorded after it
_MAX_REORDER_NS = 1_000_000_000  # ns that it is held back for a channel that lags or went silent
_TRUTH_WORDS = ("truth", "ground", "gt", "vicon", "mocap", "optitrack", "leica")
_NO_ODOMETER_WORDS = ("vio", "visual", "vins", "slam", "kiteline", "lidar", "icp", "gps", "gnss")
T = TypeVar("T")
STANDARD_GRAVITY = 9.80665  # m/s^2
_MAX_DYNAMIC_TRANSFORMS = 2000  # messages of moving transforms that are read besides the static ones


def open_source(path_name: str, mono: bool, imu: bool, given: FileCalibration | None = None) -> "McapSource":
    """Open a recording, or the bag in a folder. given: in place of a bag's calibration. Raises SourceError."""
    return McapSource(open_bag(Path(path_name)), mono, imu, given)


class McapSource:
    """A FrameSource over an MCAP file or a ROS 2 bag, whose messages are read while iterating."""

    def __init__(self, file: Bag, mono: bool, imu: bool, given: FileCalibration | None = None) -> None:
        self.name = f"mcap:{file.path}"
        self.report = SourceReport()
        self._file = file
        self._decoder = MessageDecoder()
        self._accel_in_g = False
        self._bits = 16  # that grey images of 16 bits use
        self._split_imu: ImuChoice | None = None
        self._notes: tuple[str, ...] = ()
        self._odometer_channel: int | None = None
        self._T_b_d: F64 | None = None  # the odometer's frame in the body; None: they are the same
        rig_channel = self._by_schema("kiteline.Rig")
        if rig_channel is not None:
            self._open_log(rig_channel, mono)
        else:
            self._open_bag(mono, given)
        if not imu:
            self.imu = None

    rig: CameraRig
    imu: ImuCalibration | None

    @property
    def frame_count(self) -> int | None:
        """Images of the left camera."""
        return self._file.counts.get(self._left, 0)

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Body poses of the topic named as ground truth, else of the only topic with poses."""
        channel = self._truth_channel()
        if channel is None:
            return None
        poses = list(self._each(channel, lambda message, log_ns: (read_stamp(message, log_ns), read_pose(message))))
        return sorted_trajectory(poses) if poses else None

    def close(self) -> None:
        """Nothing is held open between two readings."""

    def __iter__(self) -> Iterator[Frame | ImuBatch | OdometryBatch]:
        self.report.clear()
        self.report.notes.extend(self._notes)
        if self._file.cut:
            self.report.skip("file cut", self._file.cut.removeprefix("cut: "))
        stream = ImuStream(self.report) if self.imu is not None else None
        odometer = OdometerStream(self.report)
        frames = self._encoded_frames(stream, odometer)
        samples, grey = stream if stream is not None else NoImu(), SensorBits(self._bits)
        items = decode_frames(frames, samples, self.rig, self.report, self.name, grey)
        return insert_before_frames(items, odometer) if self._odometer_channel is not None else items

    # Opening

    def _open_log(self, rig_channel: int, mono: bool) -> None:
        raw = self._file.first(rig_channel)
        if raw is None:
            raise SourceError(f"{self.name}: the log was cut before its calibration")
        try:
            rig, self.imu = rig_from_json(json.loads(raw.data))
        except ValueError as error:
            raise SourceError(f"{self.name}: unusable calibration on {RIG} ({error})") from error
        if mono:
            rig = replace(rig, right=None, T_c_r=None, has_depth=False)
        self.rig = rig
        topics = {c.topic: i for i, c in self._file.channels.items()}
        if LEFT not in topics:
            several = sorted(topic for topic in topics if topic.endswith(LEFT))
            why = f"it merges several recordings ({', '.join(several)})" if several else "[agent.log] every was 0"
            raise SourceError(f"{self.name}: no images on {LEFT}: {why}")
        self._left = topics[LEFT]
        self._right = topics.get(RIGHT) if rig.right is not None else None
        self._depth = topics.get(DEPTH) if rig.has_depth else None
        self._imu_channel = topics.get(IMU)
        self._odometer_channel = topics.get(ODOMETER)
        self._truth_topic: int | None = topics.get(GROUND_TRUTH)
        self._is_log = True

    def _open_bag(self, mono: bool, given: FileCalibration | None) -> None:
        images, calibrations, imus = self._discover()
        tree = TransformTree(self._transforms())
        inertial, imu_notes = choose_imu(imus, tree, {i.frame_id for i in images})
        imu_frame = inertial.gyro.frame_id if inertial is not None else None
        if given is None:
            found = select_rig(self.name, images, calibrations, tree, imu_frame, mono=mono)
        else:
            found = select_given_rig(self.name, images, given, self._image_size, tree, imu_frame, mono=mono)
        self._truth_topic = None
        self._is_log = False
        self.rig, self._notes = found.rig, found.notes
        eyes = [image.channel for image in (found.left, found.right) if image is not None]
        self._bits, notes = bits_of_grey(self._each(c, lambda message, _: read_image(message, {})) for c in eyes)
        self._notes += notes
        if inertial is None or found.imu_usable:
            self._notes += imu_notes
        self._left = found.left.channel
        self._right = found.right.channel if found.right is not None else None
        self._depth = found.depth.channel if found.depth is not None else None
        self._imu_channel = None
        self.imu = None
        if inertial is not None and found.imu_usable:
            self._imu_channel = inertial.gyro.channel
            self._split_imu = inertial if inertial.split else None
            self.imu = ImuCalibration(rate_hz=self._rate_hz(self._imu_channel) or ImuCalibration().rate_hz)
            self._accel_in_g = accelerations_in_g(self._each(inertial.accel.channel, read_imu))
            if self._accel_in_g:
                self._notes += ("accelerations were in g and are turned to m/s^2",)
        self._choose_odometer(tree, found)

    def _choose_odometer(self, tree: TransformTree, found: Selection) -> None:
        """Choose the odometry topic of a bag: not ground truth, no other SLAM if possible, with known extrinsics."""
        truth = self._truth_channel(named_only=True)
        topics = [
            c
            for c, kind in self._channels()
            if kind is ChannelKind.ODOMETRY and c != truth and self._file.counts.get(c)
        ]

        def rank(channel: int) -> tuple[bool, bool, int]:
            name = self._file.channels[channel].topic.lower()
            return (
                not any(word in name for word in _NO_ODOMETER_WORDS),
                "wheel" in name,
                self._file.counts.get(channel, 0),
            )

        for channel in sorted(topics, key=rank, reverse=True):
            topic, raw = self._file.channels[channel].topic, self._file.first(channel)
            if raw is None or any(word in topic.lower() for word in _TRUTH_WORDS):
                continue
            try:
                child = read_child_frame(self._decode(raw))
            except BadMessage:
                continue
            T_l_d = tree.between(found.left.frame_id, child)
            if T_l_d is not None:
                self._odometer_channel, self._T_b_d = channel, found.T_b_l @ T_l_d
                self._notes += (f"odometry is that of {topic}",)
                return
            frames = f"its frame {child!r} and the camera's {found.left.frame_id!r}"
            self._notes += (f"odometry of {topic} left out: no static transform between {frames}",)

    def _discover(self) -> tuple[list[ImageTopic], list[tuple[str, CameraCalibration]], list[ImuTopic]]:
        """Image topics, calibrations by topic, and inertial topics."""
        images: list[ImageTopic] = []
        calibrations: list[tuple[str, CameraCalibration]] = []
        imus: list[ImuTopic] = []
        faults: list[str] = []
        for channel, kind in self._channels():
            topic = self._file.channels[channel].topic
            raw = self._file.first(channel)
            if raw is None:
                continue
            try:
                message = self._decode(raw)
                if kind is ChannelKind.IMAGE:
                    image = read_image(message, self._file.channels[channel].metadata)
                    encoded = not isinstance(image, RawPixels)
                    count = self._file.counts.get(channel, 0)
                    images.append(ImageTopic(channel, topic, read_frame_id(message), count, is_depth(image), encoded))
                elif kind is ChannelKind.CALIBRATION:
                    calibrations.append((topic, read_calibration(message)))
                elif kind is ChannelKind.IMU:
                    inertial = ImuTopic(channel, topic, read_frame_id(message), self._file.counts.get(channel, 0))
                    imus.append(what_is_measured(inertial, self._each(channel, read_imu)))
            except BadMessage as error:
                faults.append(str(error))
                if kind is ChannelKind.IMU:
                    imus.append(ImuTopic(channel, topic, "", 0, fault=str(error)))
        if faults and not images:
            raise SourceError(f"{self.name}: {faults[0]}")
        return images, calibrations, imus

    def _each(self, channel: int, read: Callable[[Any, int], T]) -> Iterator[T]:
        """What `read` makes of each message that can be read and its log time, in the order of the file."""
        for raw in self._file.messages((channel,), ordered=False):
            with suppress(BadMessage):
                yield read(self._decode(raw), raw.log_ns)

    def _image_size(self, channel: int) -> tuple[int, int]:
        raw = self._file.first(channel)
        assert raw is not None  # channels without messages are not chosen
        try:
            pixels, _ = decode_grey(read_image(self._decode(raw), self._file.channels[channel].metadata))
        except (BadImage, BadMessage) as error:
            raise SourceError(f"{self.name}: {error}") from error
        return pixels.shape[0], pixels.shape[1]

    def _transforms(self) -> list[Transform]:
        channels = [c for c, kind in self._channels() if kind is ChannelKind.TRANSFORM]
        static = [c for c in channels if "static" in self._file.channels[c].topic]
        out: list[Transform] = []
        for group, most in ((static, None), ([c for c in channels if c not in static], _MAX_DYNAMIC_TRANSFORMS)):
            if not group:
                continue
            for i, raw in enumerate(self._file.messages(group, ordered=False)):
                if most is not None and i >= most:
                    break
                with suppress(BadMessage):
                    out.extend(read_transforms(self._decode(raw)))
        return out

    def _truth_channel(self, *, named_only: bool = False) -> int | None:
        if self._is_log:
            return self._truth_topic
        kinds = (ChannelKind.POSE, ChannelKind.ODOMETRY)
        poses = [c for c, kind in self._channels() if kind in kinds and self._file.counts.get(c)]
        named = [c for c in poses if any(w in self._file.channels[c].topic.lower() for w in _TRUTH_WORDS)]
        if named:
            return max(named, key=lambda c: self._file.counts.get(c, 0))
        return poses[0] if len(poses) == 1 and not named_only else None

    def _channels(self) -> Iterator[tuple[int, ChannelKind]]:
        for channel in sorted(self._file.channels):
            schema = self._file.schema_of(channel)
            kind = KINDS.get(schema.name) if schema is not None else None
            if kind is not None:
                yield channel, kind

    def _by_schema(self, name: str) -> int | None:
        for channel in sorted(self._file.channels):
            schema = self._file.schema_of(channel)
            if schema is not None and schema.name == name:
                return channel
        return None

    def _rate_hz(self, channel: int) -> float:
        span_s = (self._file.last_ns - self._file.first_ns) * 1e-9
        return round(self._file.counts.get(channel, 0) / span_s, 1) if span_s > 0 else 0.0

    def _decode(self, raw: RawMessage) -> Any:
        data = unpacked(raw.data)
        return self._decoder.decode(self._file.channels[raw.channel], self._file.schema_of(raw.channel), data)

    # Reading

    def _encoded_frames(self, imu: ImuStream | None, odometer: OdometerStream) -> Iterator[EncodedFrame]:
        """The images, paired by time; samples met on the way are added to the streams."""
        sides = {self._left: 0}
        partner = self._right if self._right is not None else self._depth
        if partner is not None:
            sides[partner] = 1
        depths: deque[tuple[int, ImageRef]] = deque()
        both = self._right is not None and self._depth is not None

        def images() -> Iterator[tuple[int, int, ImageRef]]:
            items = self._in_order(imu is not None)
            if imu is not None and self._split_imu is not None:
                gyro, accel = self._split_imu.gyro.channel, self._split_imu.accel.channel
                items = join_imu(items, gyro, accel, ImuJoiner(self.report, self._split_imu.R_g_a))
            for t_ns, channel, item in items:
                if channel == self._imu_channel:
                    assert imu is not None
                    imu.add(t_ns, (*item[:3], *(a * STANDARD_GRAVITY for a in item[3:])) if self._accel_in_g else item)
                elif channel == self._odometer_channel:
                    odometer.add(item if self._T_b_d is None else odometry.in_body(item, self._T_b_d))
                elif both and channel == self._depth:
                    depths.append((t_ns, item))
                else:
                    yield t_ns, sides[channel], item

        if partner is None:
            for t, _, image in images():
                yield EncodedFrame(t, image)
            return
        stereo = self._right is not None
        most_ns = PAIR_TOLERANCE_NS if stereo else DEPTH_TOLERANCE_NS
        rate_hz = self._rate_hz(self._left)
        tolerance_ns = min(most_ns, int(0.5e9 / rate_hz)) if stereo and rate_hz > 0 else most_ns
        names = ("left image", "right image" if stereo else "depth image")
        for t, left, other in pair_by_time(images(), tolerance_ns, names, self.report):
            if not both:
                yield EncodedFrame(t, left, other) if stereo else EncodedFrame(t, left, depth=other)
                continue
            while depths and depths[0][0] < t:
                depths.popleft()
            yield EncodedFrame(t, left, other, depths.popleft()[1] if depths and depths[0][0] == t else None)

    def _in_order(self, with_imu: bool) -> Iterator[tuple[int, int, Any]]:
        """Images and samples (t_ns, channel, item) in order of their stamps, not of their recording."""
        wanted = [c for c in (self._left, self._right, self._depth) if c is not None]
        inertial = [self._imu_channel] if with_imu and self._imu_channel is not None else []
        if with_imu and self._split_imu is not None:
            inertial.append(self._split_imu.accel.channel)
        wanted += inertial
        if self._odometer_channel is not None:
            wanted.append(self._odometer_channel)
        log_clock = {c: fits_log_clock(self._each(c, lambda m, log_ns: (read_stamp(m, 0), log_ns))) for c in wanted}
        newest = dict.fromkeys(wanted, 0)
        heap: list[tuple[int, int, int, int, Any]] = []
        order = 0
        for raw in self._file.messages(wanted):
            unstamped_ns = raw.log_ns if log_clock[raw.channel] else 0
            try:
                message = self._decode(raw)
                if raw.channel in inertial:
                    items: list[tuple[int, Any]] = list(read_imu(message, unstamped_ns))
                elif raw.channel == self._odometer_channel:
                    batch = read_velocities(message, unstamped_ns)
                    items = [(int(batch.t_ns[-1]), batch)] if len(batch.t_ns) else []
                else:
                    metadata = self._file.channels[raw.channel].metadata
                    items = [(read_stamp(message, unstamped_ns), read_image(message, metadata))]
            except BadMessage as error:
                self.report.skip("unreadable message", str(error))
                continue
            for t_ns, item in items:
                # With equal stamps: samples first, then depth, then left and right images.
                sampled = raw.channel in inertial or raw.channel == self._odometer_channel
                rank = 0 if sampled else 1 if raw.channel == self._depth else 2
                heapq.heappush(heap, (t_ns, rank, order, raw.channel, item))
                order += 1
                newest[raw.channel] = max(newest[raw.channel], t_ns)
            front, back = max(newest.values()), min(newest.values())
            while heap and (
                heap[0][0] < front - _MAX_REORDER_NS or (heap[0][0] < front - _REORDER_NS and heap[0][0] <= back)
            ):
                t_ns, _, _, channel, item = heapq.heappop(heap)
                yield t_ns, channel, item
        while heap:
            t_ns, _, _, channel, item = heapq.heappop(heap)
            yield t_ns, channel, item
        for note in self._file.notes:
            self.report.skip("damaged chunk", note)

"""`ros2:TOPIC[,TOPIC]`: live topics of ROS 2, Image or CompressedImage, and an Imu beside them (`?imu=TOPIC`).

`?imu=GYRO,ACCEL` joins two topics that hold a half each.
"""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, Trajectory
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.calibration.files import read_calibration
from kiteline_hw.cameras import live_options
from kiteline_hw.cameras.camera import Capture
from kiteline_hw.cameras.live_options import LiveOptions
from kiteline_hw.cameras.live_source import CameraSource
from kiteline_hw.cameras.ros_node import RosNode
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.imu_buffer import ImuStream
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.sensors.split_imu import ImuJoiner
from kiteline_hw.sources.mcap_messages import BadMessage, read_image, read_imu, read_stamp
from kiteline_hw.sources.open import open_source as open_recording

_WAITING = 4  # messages that wait for the thread that decodes; the oldest are dropped
_MAX_SAMPLES = 8192  # buffered between two frames; 40 s at 200 Hz
_IMU = "imu="
_WAIT_NS = 1_000_000_000  # ns that a rate waits for the acceleration after it, which another topic brings
_AT_ONCE_NS = 20_000  # ns between two readings of a clock without a pause between them
_READINGS = 5  # of both clocks, at most


class RosCamera:
    """Images of one topic."""

    start_s = 3.0  # discovery takes a second or two

    def __init__(self, topic: str, node: RosNode) -> None:
        self.name = topic
        self._node = node
        self._subscription: Any = None
        self._messages: queue.Queue[Any] = queue.Queue(_WAITING)

    def open(self) -> str:
        """Subscribe."""
        kind = "CompressedImage" if self.name.endswith("compressed") else "Image"
        self._messages = queue.Queue(_WAITING)
        self._subscription = self._node.subscribe(getattr(self._node.types, kind), self.name, self._take)
        found = self._node.publishers(self.name)
        return f"{self.name}: {kind}, {found or 'not yet any'} publisher{'s' if found > 1 else ''}"

    def _take(self, message: Any) -> None:
        while True:
            try:
                self._messages.put_nowait(message)
                return
            except queue.Full:
                try:
                    self._messages.get_nowait()
                except queue.Empty:
                    continue

    def read(self, timeout_s: float) -> Capture | None:
        """The next image, or None if none came in time. Raises BadImage."""
        try:
            message = self._messages.get(timeout=timeout_s)
        except queue.Empty:
            return None
        try:
            return Capture(monotonic_ns(message), None, read_image(message, {}))
        except BadMessage as error:
            raise BadImage(str(error)) from error

    def close(self) -> None:
        """End the subscription; it may be opened again."""
        subscription, self._subscription = self._subscription, None
        if subscription is not None:
            self._node.unsubscribe(subscription)


def monotonic_ns(message: Any) -> int | None:
    """The stamp of a message, which is on the wall clock, on the monotonic one; None if it has none."""
    stamp_ns = read_stamp(message, 0)
    return None if stamp_ns == 0 else stamp_ns - _wall_less_monotonic_ns()


def _wall_less_monotonic_ns() -> int:
    """Difference of the two clocks. A thread that waits for its turn between two readings would add the wait."""
    least_ns, difference_ns = 2**63, 0
    for _ in range(_READINGS):
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after_ns - before_ns < least_ns:
            least_ns, difference_ns = after_ns - before_ns, wall_ns - (before_ns + after_ns) // 2
        if least_ns < _AT_ONCE_NS:
            break
    return difference_ns


class RosSource:
    """A LiveSource: frames of one topic or two, and the inertial samples of another up to each frame."""

    ground_truth: Trajectory | None = None
    frame_count: int | None = None

    def __init__(self, frames: CameraSource, node: RosNode, imu_topic: str, imu: ImuCalibration | None) -> None:
        self._frames, self._node = frames, node
        self.name, self.imu = frames.name, imu
        self._stream = ImuStream(frames.report)
        self._lock = threading.Lock()
        self._frame: Frame | None = None
        self._joiner = ImuJoiner(frames.report, wait_ns=_WAIT_NS)
        gyro, comma, accel = imu_topic.partition(",")
        if gyro:
            node.subscribe(node.types.Imu, gyro, partial(self._take_imu, self._add_gyro if comma else self._add))
        if accel:
            node.subscribe(node.types.Imu, accel, partial(self._take_imu, self._add_accel))

    @property
    def rig(self) -> CameraRig:
        return self._frames.rig

    @property
    def report(self) -> SourceReport:
        return self._frames.report

    @property
    def decode_ns(self) -> int:
        """CPU time that the threads of the cameras spent on decoding so far."""
        return self._frames.decode_ns

    @property
    def skew_ns(self) -> tuple[int, int] | None:
        """Right stamp minus left stamp over the last pairs: median, and the largest deviation from it."""
        return self._frames.skew_ns

    def _take_imu(self, add: Callable[[int, tuple[float, ...]], None], message: Any) -> None:
        try:
            rows = read_imu(message, 0)
        except BadMessage as error:
            self.report.skip("unreadable message", str(error))
            return
        t_ns = monotonic_ns(message)
        with self._lock:
            if t_ns is not None:
                add(t_ns, rows[0][1])

    def _add(self, t_ns: int, row: tuple[float, ...]) -> None:
        if not any(row[3:]):
            self.report.skip("imu sample without acceleration", "a topic of rates alone needs imu=GYRO,ACCEL")
        elif len(self._stream) < _MAX_SAMPLES:
            self._stream.add(t_ns, row)

    def _add_gyro(self, t_ns: int, row: tuple[float, ...]) -> None:
        self._joiner.add_gyro(t_ns, row[:3])

    def _add_accel(self, t_ns: int, row: tuple[float, ...]) -> None:
        for sample in self._joiner.add_accel(t_ns, row[3:]):
            self._add(*sample)

    def poll(self, until_ns: int) -> Frame | ImuBatch | None:
        """The samples up to the next frame, then the frame; None if none came in time. Late samples come with a later
        frame.
        """
        if self._frame is None:
            self._frame = self._frames.poll(until_ns)
            if self._frame is None:
                return None
            with self._lock:
                batch = self._stream.take_until(self._frame.t_ns)
            if batch is not None:
                return batch
        frame, self._frame = self._frame, None
        return frame

    def __iter__(self) -> Iterator[Frame | ImuBatch]:
        """Samples and frames as they come."""
        while not self._frames.closed:
            item = self.poll(time.monotonic_ns() + 100_000_000)
            if item is not None:
                yield item

    def take_dropped(self) -> int:
        """Number of frames since the last call that newer ones replaced before they were taken."""
        return self._frames.take_dropped()

    def take_messages(self) -> list[str]:
        """Messages to the user since the last call."""
        return self._frames.take_messages()

    def close(self) -> None:
        """End subscriptions, threads and node, within two seconds."""
        self._frames.close()
        self._node.close()


def open_source(argument: str, mono: bool, imu: bool, given: FileCalibration | None = None) -> RosSource:
    """Subscribe to topics, left first; one that nobody publishes is awaited in flight. Raises SourceError.

    imu: take the samples of the topic `?imu=` too. given: calibration in place of the one that the options name.
    """
    imu_topic, text, options = _parse(argument)
    topics = [topic for topic in text.split(",") if topic]
    if not 1 <= len(topics) <= 2 or (options.side_by_side and len(topics) == 2):
        raise SourceError(f"ros2:{argument}: expected one topic, or two (left,right) without side_by_side")
    stereo = (len(topics) == 2 or options.side_by_side) and not mono
    rig = live_options.read_rig("ros2", options, stereo=stereo, given=given)
    calibration = _imu_of(options, given) if imu and imu_topic and rig.has_body else None
    if imu and imu_topic and calibration is None:
        raise SourceError(
            f"ros2:{argument}: the IMU's noise and its place are not known: expected calibration=FILE with both (a "
            "recording of these topics with camera_info and tf_static, or Kalibr's camchain and imu.yaml), or no imu="
        )
    node = RosNode()
    cameras = [RosCamera(topic, node) for topic in (topics[:1] if mono else topics)]
    frames = CameraSource(f"ros2:{text}", rig, cameras, options.fps, options.side_by_side)
    return RosSource(frames, node, imu_topic if imu else "", calibration)


def _parse(argument: str) -> tuple[str, str, LiveOptions]:
    """Topic of the IMU (of gyroscope and accelerometer, with a comma between), topics of the images, and the options of
    every live camera.
    """
    topics, mark, query = argument.partition("?")
    items = query.split("&")
    imu = next((item.removeprefix(_IMU) for item in items if item.startswith(_IMU)), "")
    rest = "&".join(item for item in items if not item.startswith(_IMU))
    return imu, *live_options.parse("ros2", f"{topics}{mark}{rest}")


def _imu_of(options: LiveOptions, given: FileCalibration | None) -> ImuCalibration | None:
    if given is not None and given.imu is not None:
        return given.imu
    if not options.calibration:
        return None
    if options.calibration.rpartition(".")[2] in ("yaml", "yml"):
        return read_calibration(options.calibration).imu
    recorded = open_recording(options.calibration)
    try:
        return recorded.imu
    finally:
        recorded.close()

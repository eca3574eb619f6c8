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
from kiteline_hw.sensors.topic_clock import TopicClock, TopicClocks
from kiteline_hw.sources.mcap_messages import BadMessage, read_image, read_imu, read_stamp
from kiteline_hw.sources.open import open_source as open_recording

_WAITING = 4  # messages that wait for the thread that decodes; the oldest are dropped
_MAX_SAMPLES = 8192  # buffered between two frames; 40 s at 200 Hz
_IMU = "imu="
_WAIT_NS = 1_000_000_000  # ns that a rate waits for the acceleration after it, which another topic brings


class RosCamera:
    """Images of one topic."""

    start_s = 3.0  # discovery takes a second or two

    def __init__(self, topic: str, node: RosNode, clock: TopicClock) -> None:
        self.name = topic
        self._node = node
        self._clock = clock
        self._subscription: Any = None
        self._messages: queue.Queue[tuple[int, Any]] = queue.Queue(_WAITING)  # with their times

    def open(self) -> str:
        """Subscribe."""
        kind = "CompressedImage" if self.name.endswith("compressed") else "Image"
        self._messages = queue.Queue(_WAITING)
        self._subscription = self._node.subscribe(getattr(self._node.types, kind), self.name, self._take)
        found = self._node.publishers(self.name)
        return f"{self.name}: {kind}, {found or 'not yet any'} publisher{'s' if found > 1 else ''}"

    def _take(self, message: Any) -> None:
        t_ns = self._clock.to_ours(read_stamp(message, 0), time.monotonic_ns())
        while True:
            try:
                self._messages.put_nowait((t_ns, message))
                return
            except queue.Full:
                try:
                    self._messages.get_nowait()
                except queue.Empty:
                    continue

    def read(self, timeout_s: float) -> Capture | None:
        """The next image, or None if none came in time. Raises BadImage."""
        try:
            t_ns, message = self._messages.get(timeout=timeout_s)
        except queue.Empty:
            return None
        try:
            return Capture(t_ns, None, read_image(message, {}))
        except BadMessage as error:
            raise BadImage(str(error)) from error

    def close(self) -> None:
        """End the subscription; it may be opened again."""
        subscription, self._subscription = self._subscription, None
        if subscription is not None:
            self._node.unsubscribe(subscription)


class RosSource:
    """A LiveSource: frames of one topic or two, and the inertial samples of another up to each frame."""

    ground_truth: Trajectory | None = None
    frame_count: int | None = None

    def __init__(
        self, frames: CameraSource, node: RosNode, clocks: TopicClocks, imu_topic: str, imu: ImuCalibration | None
    ) -> None:
        """clocks: of the frames' topics, and for those of the IMU."""
        self._frames, self._node, self._clocks = frames, node, clocks
        self.name, self.imu = frames.name, imu
        self._stream = ImuStream(frames.report)
        self._lock = threading.Lock()
        self._frame: Frame | None = None
        self._joiner = ImuJoiner(frames.report, wait_ns=_WAIT_NS)
        gyro, comma, accel = imu_topic.partition(",")
        if gyro:
            self._subscribe(gyro, self._add_gyro if comma else self._add)
        if accel:
            self._subscribe(accel, self._add_accel)

    def _subscribe(self, topic: str, add: Callable[[int, tuple[float, ...]], None]) -> None:
        clock = self._clocks.topic(f"imu {topic} tells no sample times")
        self._node.subscribe(self._node.types.Imu, topic, partial(self._take_imu, add, clock))

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

    def _take_imu(self, add: Callable[[int, tuple[float, ...]], None], clock: TopicClock, message: Any) -> None:
        now_ns = time.monotonic_ns()
        try:
            rows = read_imu(message, 0)
        except BadMessage as error:
            self.report.skip("unreadable message", str(error))
            return
        t_ns = clock.to_ours(read_stamp(message, 0), now_ns)
        with self._lock:
            add(t_ns, rows[0][1])

    def _add(self, t_ns: int, row: tuple[float, ...]) -> None:
        if not any(row[3:]):
            self.report.skip("imu sample without acceleration", "a topic of rates alone needs imu=GYRO,ACCEL")
        elif len(self._stream) >= _MAX_SAMPLES:
            self.report.skip("imu sample beyond the buffer", f"at {t_ns} ns: no image came for too long")
        else:
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
        return self._frames.take_messages() + self._clocks.take_messages()

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
    node, clocks = RosNode(), TopicClocks()
    cameras = [
        RosCamera(topic, node, clocks.topic(f"camera {topic} tells no capture times"))
        for topic in (topics[:1] if mono else topics)
    ]
    frames = CameraSource(f"ros2:{text}", rig, cameras, options.fps, options.side_by_side)
    return RosSource(frames, node, clocks, imu_topic if imu else "", calibration)


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

"""A LiveSource over one or two cameras: each is read, decoded and opened again by a thread of its own."""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np

from kiteline_core.arrays import U8
from kiteline_core.frame import EncodedImage, Frame, ImuCalibration, Trajectory
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.cameras.camera import Camera, CameraError, Capture
from kiteline_hw.cameras.camera_watch import CameraWatch
from kiteline_hw.cameras.live_pairs import LiveImage, LivePairs, Pair
from kiteline_hw.ports import SourceReport
from kiteline_hw.sensors.frames import PAIR_TOLERANCE_NS
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.sensors.sensor_bits import SensorBits
from kiteline_hw.system.clock import MonotonicClock

_READ_S = 0.05  # s that a camera's thread waits for an image at most
_FIRST_RETRY_S = 0.1  # s until a lost device is opened again; doubled at each failure
_MAX_RETRY_S = 1.0
_WAITING = 2  # frames that wait for the agent: a step that lasts longer than a period loses none
_OLDEST_NS = 1_000_000_000  # ns; stamps older than this, or in the future, are of another clock


class CameraSource:
    """Frames of one camera, of two, or of one whose images hold both views side by side.

    side_by_side: the left half of an image is the left view. fps: expected rate in Hz.
    """

    imu: ImuCalibration | None = None
    ground_truth: Trajectory | None = None
    frame_count: int | None = None

    def __init__(
        self, name: str, rig: CameraRig, cameras: Sequence[Camera], fps: float,
        side_by_side: bool = False,
    ) -> None:  # fmt: skip
        self.name, self.rig = name, rig
        self.report = SourceReport()
        self._cameras = tuple(cameras)
        self._side_by_side = side_by_side
        self._period_ns = round(1e9 / fps)
        self._watches = [CameraWatch(camera.name, round(camera.start_s * 1e9)) for camera in cameras]
        self._pairs = LivePairs(min(PAIR_TOLERANCE_NS, self._period_ns // 2), self._tell)
        self._grey = SensorBits()  # of all cameras: their threads only ever raise it
        self._clock = MonotonicClock()
        self._lock = threading.Condition()
        self._frames: deque[tuple[int, Frame]] = deque()  # with their arrival in ns
        self._messages: list[str] = []
        self._arrival_stamps = [False] * len(self._cameras)
        self._dropped = 0
        self._decode_ns = 0
        self._last_ns = -(2**63)
        self._closed = threading.Event()
        self._threads: list[threading.Thread] = []

    def __iter__(self) -> Iterator[Frame]:
        """Frames as they come, until `close`."""
        while not self._closed.is_set():
            frame = self.poll(self._clock.now_ns() + 100_000_000)
            if frame is not None:
                yield frame

    @property
    def closed(self) -> bool:
        """True after `close`."""
        return self._closed.is_set()

    @property
    def decode_ns(self) -> int:
        """CPU time that the threads spent on decoding so far."""
        return self._decode_ns

    @property
    def skew_ns(self) -> tuple[int, int] | None:
        """Right stamp minus left stamp over the last pairs: median, and the largest deviation from it."""
        with self._lock:
            return self._pairs.skew_ns

    def poll(self, until_ns: int) -> Frame | None:
        """The next frame, awaited until a time of the monotonic clock at most. Begins the capture when first called."""
        if not self._threads and not self._closed.is_set():
            for side in range(len(self._cameras)):
                name = f"camera-{'left' if side == 0 else 'right'}"
                self._threads.append(threading.Thread(target=self._run, args=(side,), name=name, daemon=True))
            for thread in self._threads:
                thread.start()
        with self._lock:
            while not self._frames:
                wait_s = (until_ns - self._clock.now_ns()) / 1e9
                if wait_s <= 0.0 or self._closed.is_set():
                    return None
                self._lock.wait(wait_s)
            # An agent that cannot keep up gets the newest frame, one that was late once loses none.
            while len(self._frames) > 1 and self._clock.now_ns() - self._frames[0][0] >= self._period_ns:
                self._frames.popleft()
                self._dropped += 1
            return self._frames.popleft()[1]

    def take_dropped(self) -> int:
        """Number of frames since the last call that newer ones replaced before they were taken."""
        with self._lock:
            dropped, self._dropped = self._dropped, 0
        return dropped

    def take_messages(self) -> list[str]:
        """Messages to the user since the last call."""
        if not self._messages:
            return []
        with self._lock:
            messages, self._messages = self._messages, []
        return messages

    def close(self) -> None:
        """End the threads and release the devices, within a second. May be called twice."""
        self._closed.set()
        with self._lock:
            self._frames.clear()
            self._lock.notify_all()
        for thread in self._threads:
            thread.join(1.0)

    def _tell(self, text: str | None) -> None:
        if text is not None:
            self._messages.append(text)

    # A camera's thread

    def _run(self, side: int) -> None:
        camera, watch = self._cameras[side], self._watches[side]
        is_open, told_open, retry_s = False, False, _FIRST_RETRY_S
        while not self._closed.is_set():
            try:
                if not is_open:
                    about = camera.open()
                    is_open = True
                    with self._lock:
                        watch.opened(self._clock.now_ns())
                        if not told_open:
                            self._tell(f"camera {about}")
                    told_open = True
                capture = camera.read(_READ_S)
                if capture is not None:
                    self._take(side, capture)
                    retry_s = _FIRST_RETRY_S
                    continue
            except BadImage as error:
                self._count_bad(watch, str(error))
            except Exception as error:  # whatever a driver or library does, the flight goes on
                known = isinstance(error, CameraError)
                text = str(error) if known else f"camera {camera.name} failed: {type(error).__name__}: {error}"
                _release(camera)
                is_open = False
                with self._lock:
                    self._tell(watch.failed(self._clock.now_ns(), text))
                self._closed.wait(retry_s)
                retry_s = min(2.0 * retry_s, _MAX_RETRY_S)
                continue
            if self._check(watch):
                _release(camera)
                is_open = False
        _release(camera)

    def _check(self, watch: CameraWatch) -> bool:
        """Report outages and pass on unpaired images while no image comes. True if the device must be reopened."""
        now_ns = self._clock.now_ns()
        with self._lock:
            self._tell(watch.check(now_ns))
            if len(self._cameras) > 1:
                self._give(self._pairs.expire(now_ns, self._patience_ns))
            return watch.needs_restart(now_ns)

    @property
    def _patience_ns(self) -> int:
        """How long a left image waits for the right one: not at all while that camera is away."""
        return self._period_ns if all(watch.well for watch in self._watches) else 0

    def _count_bad(self, watch: CameraWatch, why: str) -> None:
        with self._lock:
            self.report.skip("unreadable image", why)
            self._tell(watch.bad_image(self._clock.now_ns(), why))

    def _take(self, side: int, capture: Capture) -> None:
        """Decode one capture, pair it, and hand frames over. Raises BadImage."""
        now_ns = self._clock.now_ns()
        begin_ns = time.thread_time_ns()
        pixels, encoded = self._grey.decode(capture.image)
        images = self._views(side, pixels, encoded, self._stamp(side, capture.t_ns, now_ns))
        spent_ns = time.thread_time_ns() - begin_ns
        watch = self._watches[side]
        with self._lock:
            self._decode_ns += spent_ns
            self._tell(self._grey.take_note())
            missing = watch.missing
            self._tell(watch.image(now_ns, capture.sequence))
            for _ in range(min(1000, watch.missing - missing)):
                self.report.skip("image lost by camera or driver", f"{watch.missing} before {capture.sequence}")
            if len(self._cameras) == 1:
                self._give([(images[0], images[1] if len(images) > 1 else None)])
            else:
                self._give(self._pairs.add(side, images[0], now_ns))
                self._give(self._pairs.expire(now_ns, self._patience_ns))

    def _views(self, side: int, pixels: U8, encoded: EncodedImage | None, t_ns: int) -> list[LiveImage]:
        """The views that an image holds. Raises BadImage if it has another size than the calibration."""
        model = self.rig.left if side == 0 or self.rig.right is None else self.rig.right
        width = 2 * model.width if self._side_by_side else model.width
        if pixels.shape != (model.height, width):
            raise BadImage(f"{pixels.shape[1]}x{pixels.shape[0]} px where the calibration says {width}x{model.height}")
        if not self._side_by_side:
            return [LiveImage(t_ns, pixels, encoded)]
        halves = (pixels[:, : model.width], pixels[:, model.width :])
        kept = halves if self.rig.right is not None else halves[:1]
        return [LiveImage(t_ns, np.ascontiguousarray(half), None) for half in kept]

    def _stamp(self, side: int, t_ns: int | None, now_ns: int) -> int:
        """The stamp of an image; its arrival where the device has no stamp on our clock."""
        if t_ns is not None and now_ns - _OLDEST_NS <= t_ns <= now_ns:
            return t_ns
        if not self._arrival_stamps[side]:
            self._arrival_stamps[side] = True
            with self._lock:
                self._tell(
                    f"camera {self._cameras[side].name} tells no capture times on the monotonic clock: "
                    "images count from their arrival, expect a delay of a frame or two"
                )
        return now_ns

    def _give(self, pairs: Sequence[Pair]) -> None:
        """Hand frames to the agent; the oldest one is dropped where too many wait. Under the lock."""
        for left, right in pairs:
            if left.t_ns <= self._last_ns:
                self.report.skip("frame stamp not increasing", f"{left.t_ns} ns after {self._last_ns} ns")
                continue
            if self._closed.is_set():
                return
            self._last_ns = left.t_ns
            if right is None and self.rig.right is not None:
                self.report.skip("missing right image", f"left image at {left.t_ns} ns has no partner")
            images = (left.encoded,) if right is None else (left.encoded, right.encoded)
            encoded = tuple(image for image in images if image is not None)
            frame = Frame(
                left.t_ns, left.pixels, None if right is None else right.pixels,
                encoded=encoded if len(encoded) == len(images) else (),
            )  # fmt: skip
            self._frames.append((self._clock.now_ns(), frame))
            if len(self._frames) > _WAITING:
                self._frames.popleft()
                self._dropped += 1
            self._lock.notify_all()


def _release(camera: Camera) -> None:
    """Close a device. Whatever a driver or library raises then, it is opened again."""
    with contextlib.suppress(Exception):
        camera.close()

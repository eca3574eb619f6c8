"""`picamera:N[,N]`: cameras on a Raspberry Pi's ribbon cables, through Picamera2 of the system (libcamera)."""

import contextlib
import importlib
import time
from concurrent.futures import CancelledError
from dataclasses import dataclass
from typing import Any

import numpy as np

from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.cameras import live_options
from kiteline_hw.cameras.camera import CameraError, Capture
from kiteline_hw.cameras.live_source import CameraSource
from kiteline_hw.ports import SourceError
from kiteline_hw.sensors.raw_pixels import RawPixels

_BUFFERS = 4


@dataclass(frozen=True, slots=True)
class PiSettings:
    """What is asked of a camera. width, height: px. fps: Hz. exposure_ms, gain: -1: as the camera wants."""

    width: int
    height: int
    fps: float
    exposure_ms: float
    gain: float


class PiCamera:
    """One camera of Picamera2, by number: grey images with the sensor's stamps."""

    start_s = 3.0  # libcamera measures exposure first

    def __init__(self, number: int, settings: PiSettings) -> None:
        self.name = f"picamera {number}"
        self._number = number
        self._settings = settings
        self._camera: Any = None
        self._job: Any = None  # the request for the next image, queued in Picamera2

    def open(self) -> str:
        """Start the camera; what was chosen, for the user. Raises CameraError."""
        s = self._settings
        try:
            library = importlib.import_module("picamera2")
        except ImportError as error:
            raise CameraError(
                "Picamera2 is not installed: `apt install python3-picamera2`, and a virtual environment made with "
                "--system-site-packages", passing=False,
            ) from error  # fmt: skip
        controls: dict[str, float] = {"FrameRate": s.fps}
        if s.exposure_ms >= 0.0:
            controls["ExposureTime"] = round(1000.0 * s.exposure_ms)
        if s.gain >= 0.0:
            controls["AnalogueGain"] = s.gain
        try:
            self._camera = library.Picamera2(self._number)
            # The first plane of YUV420 is the grey image.
            main = {"size": (s.width, s.height), "format": "YUV420"}
            self._camera.configure(
                self._camera.create_video_configuration(main=main, buffer_count=_BUFFERS, controls=controls)
            )
            self._camera.start()
        except (RuntimeError, IndexError, OSError) as error:
            self.close()
            raise CameraError(
                f"camera {self.name} cannot be started ({error}): check its ribbon cable, and that no other program "
                "uses it (`rpicam-hello --list-cameras` shows it)"
            ) from error
        return f"{self.name}: {s.width}x{s.height} YUV420 at {s.fps:g} Hz"

    def read(self, timeout_s: float) -> Capture | None:
        """The next image, or None if none came in time. Raises CameraError."""
        try:
            # A job that nobody waits for any more still takes an image and its buffer: one job is kept until it ends.
            self._job = self._job or self._camera.capture_request(wait=False)
            request = self._job.get_result(timeout=timeout_s)
        except TimeoutError:
            return None
        except CancelledError:  # by `close` from another thread
            return None
        except (RuntimeError, OSError) as error:
            self._job = None
            raise CameraError(f"camera {self.name} failed ({error}): check its ribbon cable") from error
        self._job = None
        try:
            stamp = request.get_metadata().get("SensorTimestamp")
            rows = np.asarray(request.make_array("main"), np.uint8)
        finally:
            request.release()
        s = self._settings
        grey = np.ascontiguousarray(rows[: s.height, : s.width])
        return Capture(_monotonic(stamp), None, RawPixels(grey.shape[1], grey.shape[0], "mono8", 0, grey.tobytes()))

    def close(self) -> None:
        """Stop the camera; it may be started again."""
        camera, self._camera, self._job = self._camera, None, None
        if camera is None:
            return
        steps = [camera.stop, camera.close]
        if hasattr(camera, "cancel_all_and_flush"):  # since 0.3.20; `stop` would wait behind the queued job
            steps.insert(0, camera.cancel_all_and_flush)
        for step in steps:  # a camera that cannot be stopped, for whatever reason, is released nevertheless
            with contextlib.suppress(Exception):
                step()


def open_source(argument: str, mono: bool, imu: bool, given: FileCalibration | None = None) -> CameraSource:
    """Open cameras by number, left first. Raises SourceError. given: as of `v4l2:`."""
    del imu
    text, options = live_options.parse("picamera", argument)
    numbers = [number for number in text.split(",") if number]
    if not 1 <= len(numbers) <= 2 or not all(number.isdecimal() for number in numbers) or options.side_by_side:
        raise SourceError(f"picamera:{argument}: expected the number of a camera, or two (left,right), such as 0,1")
    stereo = len(numbers) == 2 and not mono
    rig = live_options.read_rig("picamera", options, stereo=stereo, given=given)
    models = [rig.left, rig.right or rig.left][: 1 + stereo]
    cameras = [
        PiCamera(int(number), PiSettings(model.width, model.height, options.fps, options.exposure_ms, options.gain))
        for number, model in zip(numbers, models, strict=False)
    ]
    return CameraSource(f"picamera:{text}", rig, cameras, options.fps)


def _monotonic(stamp_ns: int | None) -> int | None:
    """A stamp of the boot clock, which libcamera uses, on the monotonic clock, which stands still in suspend."""
    if stamp_ns is None:
        return None
    return stamp_ns - (time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns())

"""Picamera2 behind a model of its interface."""

import sys
import threading
import time
from concurrent.futures import CancelledError, Future
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest

from kiteline_hw.cameras.live_source import CameraSource
from kiteline_hw.cameras.picamera import PiCamera, PiSettings
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source

W, H, PERIOD_S, FIRST_S = 64, 48, 0.02, 0.4


class Request:
    """A completed request: it holds one of the camera's buffers until it is released."""

    released = 0

    def __init__(self, camera: "Picamera2") -> None:
        self._camera = camera
        self._stamp_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - 3_000_000

    def get_metadata(self) -> dict[str, int]:
        return {"SensorTimestamp": self._stamp_ns}

    def make_array(self, name: str) -> Any:
        assert name == "main"
        return np.pad(np.full((H, W), 77, np.uint8), ((0, H // 2), (0, 64)))  # chroma below, padding at the right

    def release(self) -> None:
        Request.released += 1
        self._camera.free += 1


class Job:
    """A queued function; it ends when an image comes, whether or not somebody waits."""

    def __init__(self) -> None:
        self.future: Future[Any] = Future()

    def get_result(self, timeout: float | None = None) -> Any:
        return self.future.result(timeout)


class Picamera2:
    """The job queue of Picamera2: each image goes to the first job, and `stop` is a job behind the others."""

    asked: ClassVar[dict[str, Any]] = {}
    opened: ClassVar[list["Picamera2"]] = []
    failing = False
    silent = False

    def __init__(self, number: int) -> None:
        if number > 1:
            raise IndexError("list index out of range")
        self.jobs: list[Job] = []
        self.free, self.running, self.closed = 0, threading.Event(), False
        Picamera2.opened.append(self)

    def create_video_configuration(self, **asked: Any) -> dict[str, Any]:
        return asked

    def configure(self, asked: dict[str, Any]) -> None:
        Picamera2.asked = asked
        self.free = asked["buffer_count"]

    def start(self) -> None:
        self.running.set()
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        time.sleep(FIRST_S)
        while self.running.is_set():
            if self.free > 0 and self.jobs and not Picamera2.silent:
                self.free -= 1
                self.jobs.pop(0).future.set_result(Request(self))
            time.sleep(PERIOD_S)

    def capture_request(self, wait: float | bool) -> Any:
        if Picamera2.failing:
            raise RuntimeError("Camera frontend has timed out")
        job = Job()
        self.jobs.append(job)
        return job if wait is False else job.get_result(float(wait))

    def cancel_all_and_flush(self) -> None:
        while self.jobs:
            self.jobs.pop().future.set_exception(CancelledError())

    def stop(self) -> None:
        while self.jobs:
            time.sleep(0.01)
        self.running.clear()
        if Picamera2.failing:
            raise RuntimeError("Device or resource busy")

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def calibration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(Picamera2, "opened", [])
    library = ModuleType("picamera2")
    library.Picamera2 = Picamera2  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "picamera2", library)
    path = tmp_path / "camera.yaml"
    path.write_text(f"fx: 50\nfy: 50\ncx: 32\ncy: 24\nwidth: {W}\nheight: {H}\n")
    return path


def said_until(source: CameraSource, word: str) -> list[str]:
    out: list[str] = []
    end_s = time.monotonic() + 5.0
    while not any(word in line for line in out):
        assert time.monotonic() < end_s, out
        source.poll(time.monotonic_ns() + 10_000_000)
        out += source.take_messages()
    return out


def test_images_stamps_settings_and_a_failure(calibration: Path) -> None:
    source = open_source(f"picamera:0?fps=50&exposure_ms=4&gain=2&calibration={calibration}")
    assert isinstance(source, CameraSource)
    try:
        frame = source.poll(time.monotonic_ns() + 5_000_000_000)
        assert frame.left.shape == (H, W) and (frame.left == 77).all()
        assert 3_000_000 <= time.monotonic_ns() - frame.t_ns < 200_000_000
        assert Picamera2.asked["controls"] == {"FrameRate": 50.0, "ExposureTime": 4000, "AnalogueGain": 2.0}
        said_until(source, "YUV420 at 50 Hz")
        Picamera2.failing = True
        assert "check its ribbon cable" in said_until(source, "failed")[-1]
        Picamera2.failing = False
        assert len(said_until(source, "again after")) == 1
    finally:
        Picamera2.failing = False
        source.close()
    assert Request.released > 0


@pytest.mark.parametrize("where", ["library", "camera"])
def test_a_camera_that_cannot_be_closed_is_opened_again(
    calibration: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    def fail(_: object) -> None:
        raise TypeError("'NoneType' object is not callable")

    monkeypatch.setattr(*((Picamera2, "cancel_all_and_flush") if where == "library" else (PiCamera, "close")), fail)
    source = open_source(f"picamera:0?fps=50&calibration={calibration}")
    assert isinstance(source, CameraSource)
    try:
        said_until(source, "YUV420")
        monkeypatch.setattr(Picamera2, "failing", True)
        said_until(source, "failed")
        monkeypatch.setattr(Picamera2, "failing", False)
        assert len(said_until(source, "again after")) == 1
    finally:
        source.close()


def test_images_that_come_later_than_a_read_waits_are_not_lost(
    calibration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[__name__], "PERIOD_S", 0.08)  # a read of the source waits 0.05 s
    source = open_source(f"picamera:0?fps=12&calibration={calibration}")
    assert isinstance(source, CameraSource)
    try:
        for _ in range(8):  # more than there are buffers
            assert source.poll(time.monotonic_ns() + 2_000_000_000) is not None
    finally:
        source.close()
    assert len(Picamera2.opened) == 1 and Picamera2.opened[0].closed


@pytest.mark.parametrize("stop_fails", [False, True])
def test_a_camera_that_falls_silent_is_stopped_and_released(
    calibration: Path, monkeypatch: pytest.MonkeyPatch, stop_fails: bool
) -> None:
    camera = PiCamera(0, PiSettings(W, H, 50.0, -1.0, -1.0))
    camera.open()
    monkeypatch.setattr(Picamera2, "silent", True)
    assert camera.read(0.05) is None and camera.read(0.05) is None
    opened = Picamera2.opened[0]
    assert len(opened.jobs) == 1
    monkeypatch.setattr(Picamera2, "failing", stop_fails)
    closing = threading.Thread(target=camera.close, daemon=True)
    closing.start()
    closing.join(2.0)
    assert opened.closed and not opened.running.is_set()


def test_what_is_missing_is_said(calibration: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SourceError, match="expected the number of a camera"):
        open_source("picamera:front")
    source = open_source(f"picamera:7?calibration={calibration}")
    assert isinstance(source, CameraSource)
    assert "rpicam-hello --list-cameras" in said_until(source, "cannot be started")[0]
    source.close()
    monkeypatch.setitem(sys.modules, "picamera2", None)
    source = open_source(f"picamera:0?calibration={calibration}")
    assert isinstance(source, CameraSource)
    assert "apt install python3-picamera2" in said_until(source, "not installed")[0]
    source.close()

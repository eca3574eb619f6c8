"""Picamera2 behind a model of its interface."""

import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest

from kiteline_hw.cameras.live_source import CameraSource
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source

W, H, PERIOD_S = 64, 48, 0.02


class Request:
    released = 0

    def __init__(self, stamp_ns: int) -> None:
        self._stamp_ns = stamp_ns

    def get_metadata(self) -> dict[str, int]:
        return {"SensorTimestamp": self._stamp_ns}

    def make_array(self, name: str) -> Any:
        assert name == "main"
        return np.pad(np.full((H, W), 77, np.uint8), ((0, H // 2), (0, 64)))  # chroma below, padding at the right

    def release(self) -> None:
        Request.released += 1


class Picamera2:
    asked: ClassVar[dict[str, Any]] = {}
    failing = False

    def __init__(self, number: int) -> None:
        if number > 1:
            raise IndexError("list index out of range")

    def create_video_configuration(self, **asked: Any) -> dict[str, Any]:
        return asked

    def configure(self, asked: dict[str, Any]) -> None:
        Picamera2.asked = asked

    def start(self) -> None:
        self.next_s = time.monotonic()

    def capture_request(self, wait: float) -> Request:
        if Picamera2.failing:
            raise RuntimeError("Camera frontend has timed out")
        self.next_s += PERIOD_S
        left_s = self.next_s - time.monotonic()
        time.sleep(max(0.0, min(wait, left_s)))
        if left_s > wait:
            raise TimeoutError
        return Request(time.clock_gettime_ns(time.CLOCK_BOOTTIME) - 3_000_000)

    def stop(self) -> None: ...
    def close(self) -> None: ...


@pytest.fixture
def calibration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
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

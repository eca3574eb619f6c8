"""`kiteline doctor --camera`: modelled devices with each fault, and the verdict on it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_hw.cameras import v4l2
from kiteline_hw.sim.sensors.video_device import ModelDevice, ModelKernel
from kiteline_lab.tools import doctor
from kiteline_lab.tools.checks import cameras
from kiteline_lab.tools.checks.check import DoctorCheck, Severity

W, H = 320, 240
RNG = np.random.default_rng(3)
BOXES = cv2.resize(RNG.integers(60, 190, (H // 12, W // 12), np.uint8), (W, H), interpolation=cv2.INTER_NEAREST)
SHARP = cv2.GaussianBlur(BOXES, (0, 0), 0.5)
Image = Callable[[int], bytes]


def still(image: np.ndarray) -> Image:
    data = np.ascontiguousarray(image, np.uint8).tobytes()
    return lambda k: data


def pair(left: Image | None = None, right: Image | None = None, **of_right: float) -> list[ModelDevice]:
    images = (left or still(SHARP), right or still(SHARP))
    devices = [ModelDevice(image, {"GREY": [(W, H)]}, 20.0) for image in images]
    devices[0].begin_ns = devices[1].begin_ns = time.monotonic_ns()  # one clock triggers both
    for name, value in of_right.items():
        setattr(devices[1], name, value)
    return devices


@pytest.fixture
def checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    (tmp_path / "camera.yaml").write_text(
        f"fx: 200\nfy: 200\ncx: 159.5\ncy: 119.5\nwidth: {W}\nheight: {H}\nbaseline_m: 0.1\n"
    )

    def check(devices: list[ModelDevice], options: str = "fps=20", seconds: float = 1.5) -> dict[str, DoctorCheck]:
        paths = ["/dev/video0", "/dev/video2"][: len(devices)]
        monkeypatch.setattr(v4l2, "KERNEL", ModelKernel(dict(zip(paths, devices, strict=True))))
        spec = f"v4l2:{','.join(paths)}?{options}&calibration={tmp_path / 'camera.yaml'}"
        return {found.name: found for found in cameras.check_cameras(spec, seconds=seconds)}

    return check


def test_a_good_pair_is_good_in_all(checked) -> None:  # type: ignore[no-untyped-def]
    found = checked(pair())
    assert {name for name, check in found.items() if check.severity is not Severity.OK} <= {"camera stamps"}
    assert list(found) == ["cameras", "camera rate", "camera stamps", "camera drops", "camera skew", "camera exposure",
                           "camera sharpness"]  # fmt: skip
    assert "320x240 GREY" in found["cameras"].text and found["cameras"].text.count("/dev/video") == 2
    assert "20.0 Hz" in found["camera rate"].text


def test_the_skew_of_a_pair_has_a_remedy(checked) -> None:  # type: ignore[no-untyped-def]
    skew = checked(pair(offset_s=0.003))["camera skew"]
    assert skew.severity is Severity.NOTE and "+3.0" in skew.text and "one signal" in skew.remedy
    found = checked(pair(offset_s=0.008), seconds=2.0)
    assert found["camera skew"].severity is Severity.FAIL and " ms apart" in found["camera skew"].text
    assert found["cameras"].severity is Severity.OK and found["cameras"].text.count("/dev/video") == 2


def test_lost_images_count(checked) -> None:  # type: ignore[no-untyped-def]
    devices = pair()
    show = devices[0].image

    def image(k: int) -> bytes:
        if k == 10:
            devices[0].lose(5)
        return show(k)

    devices[0].image = image
    drops = checked(devices)["camera drops"]
    assert drops.severity is Severity.FAIL and "lost by camera or driver" in drops.text and "USB" in drops.remedy


def test_looking_at_images_loses_none_on_a_slow_computer(checked, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    ratio = cameras.edge_ratio

    def slow(view: np.ndarray) -> float:
        time.sleep(0.07)
        return ratio(view)

    monkeypatch.setattr(cameras, "edge_ratio", slow)
    gone, _, all_, *_ = checked(pair())["camera drops"].text.partition(":")[0].split()
    assert int(gone) < 0.1 * int(all_)  # a quarter, where images are looked at as they come


def test_a_program_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(f"fx: 200\nfy: 200\ncx: 159.5\ncy: 119.5\nwidth: {W}\nheight: {H}\n")
    monkeypatch.setattr(cameras, "_PATIENCE_S", 0.5)
    monkeypatch.setenv("PATH", str(tmp_path))
    (found,) = cameras.check_cameras(f"stream:rtsp://127.0.0.1:9/a?calibration={tmp_path / 'camera.yaml'}")
    assert found.severity is Severity.FAIL and "apt install ffmpeg" in found.text and "cable" not in found.remedy


def test_a_rate_that_is_not_as_asked(checked) -> None:  # type: ignore[no-untyped-def]
    devices = pair()
    for device in devices:
        device.fps = 10.0
    rate = checked(devices)["camera rate"]
    assert rate.severity is Severity.FAIL and "10.0 Hz, asked for 20" in rate.text


def test_stamps_of_another_clock_are_told(checked) -> None:  # type: ignore[no-untyped-def]
    devices = pair()
    for device in devices:
        device.monotonic = False
    stamps = checked(devices)["camera stamps"]
    assert stamps.severity is Severity.NOTE and "count from their arrival" in stamps.text


@pytest.mark.parametrize(
    ("left", "right", "severity", "words"),
    [
        (SHARP // 8, SHARP // 8, Severity.FAIL, "too dark"),
        (np.minimum(SHARP.astype(int) + 140, 255), np.minimum(SHARP.astype(int) + 140, 255), Severity.FAIL, "bright"),
        (SHARP, SHARP // 2, Severity.NOTE, "differ"),
        (np.where(SHARP > 165, 255, SHARP), SHARP, Severity.NOTE, "black or white"),
    ],
)
def test_exposure(checked, left, right, severity, words) -> None:  # type: ignore[no-untyped-def]
    exposure = checked(pair(still(left), still(right)), seconds=0.5)["camera exposure"]
    assert exposure.severity is severity and words in exposure.text and exposure.remedy


def test_a_blurred_lens_is_found_on_its_side_and_a_blank_wall_is_not_called_blurred(checked) -> None:  # type: ignore[no-untyped-def]
    blurred = checked(pair(right=still(cv2.GaussianBlur(SHARP, (0, 0), 2.0))), seconds=0.5)["camera sharpness"]
    assert blurred.severity is Severity.FAIL and "right one" in blurred.text and "focus" in blurred.remedy
    bare = checked(pair(*[still(np.full((H, W), 128))] * 2), seconds=0.5)["camera sharpness"]
    assert bare.severity is Severity.NOTE and "texture" in bare.remedy


def test_sharpness_is_of_the_lens_not_of_the_scene() -> None:
    for low, high, size in ((100, 140, 12), (10, 240, 12), (60, 190, 30), (60, 190, 6)):
        image = RNG.integers(low, high, (H // size, W // size), np.uint8)
        scene = cv2.GaussianBlur(cv2.resize(image, (W, H), interpolation=cv2.INTER_NEAREST), (0, 0), 0.5)
        assert cameras.edge_ratio(scene) > cameras._SHARP
        assert cameras.edge_ratio(cv2.GaussianBlur(scene, (0, 0), 2.0)) < cameras._BLURRED


def test_a_camera_that_is_away_fails_and_says_so_as_json(
    checked, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(cameras, "_PATIENCE_S", 0.5)
    monkeypatch.setattr(doctor, "CHECKS", ())
    monkeypatch.setattr(v4l2, "KERNEL", ModelKernel({}))
    calibration = tmp_path / "camera.yaml"
    assert doctor.main(["--camera", f"v4l2:/dev/video0?calibration={calibration}", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)["checks"]
    assert [c["name"] for c in told] == ["cameras"] and "is not there" in told[0]["text"]
    assert doctor.main(["--camera", "v4l2:/dev/video0?fps=none", "--json"]) == 1
    assert "expected a float" in json.loads(capsys.readouterr().out)["checks"][0]["text"]


def test_the_beginning_of_a_recording_is_judged_too(data_dir: Path) -> None:
    found = {c.name: c for c in cameras.check_cameras(str(data_dir / "kitti_straight"), seconds=1.0)}
    assert list(found) == ["cameras", "camera exposure", "camera sharpness"]
    assert found["camera sharpness"].severity is Severity.OK

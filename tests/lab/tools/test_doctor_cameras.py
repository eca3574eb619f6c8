"""`kiteline doctor --camera`: modelled devices with each fault, and the verdict on it."""

import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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


Found = dict[str, DoctorCheck]


def check(kernel: dict[str, ModelDevice], folder: Path, seconds: float) -> Found:
    """The verdicts on a pair that is watched for some seconds."""
    (folder / "camera.yaml").write_text(
        f"fx: 200\nfy: 200\ncx: 159.5\ncy: 119.5\nwidth: {W}\nheight: {H}\nbaseline_m: 0.1\n"
    )
    spec = f"v4l2:{','.join(kernel)}?fps=20&calibration={folder / 'camera.yaml'}"
    return {found.name: found for found in cameras.check_cameras(spec, seconds=seconds)}


def losing() -> list[ModelDevice]:
    devices = pair()
    show = devices[0].image

    def image(k: int) -> bytes:
        if k == 10:
            devices[0].lose(5)
        return show(k)

    devices[0].image = image
    return devices


def both(**values: float) -> list[ModelDevice]:
    devices = pair(**values)
    for name, value in values.items():
        setattr(devices[0], name, value)
    return devices


CLIPPED = np.minimum(SHARP.astype(int) + 140, 255)
PAIRS: dict[str, tuple[Callable[[], list[ModelDevice]], float]] = {  # what is watched, for how many seconds
    "good": (pair, 1.5),
    "a little apart": (lambda: pair(offset_s=0.003), 1.5),
    "apart": (lambda: pair(offset_s=0.008), 2.0),
    "losing": (losing, 1.5),
    "slow": (lambda: both(fps=10.0), 1.5),
    "another clock": (lambda: both(monotonic=False), 1.5),
    "dark": (lambda: pair(still(SHARP // 8), still(SHARP // 8)), 0.5),
    "bright": (lambda: pair(still(CLIPPED), still(CLIPPED)), 0.5),
    "unequal": (lambda: pair(still(SHARP), still(SHARP // 2)), 0.5),
    "clipped": (lambda: pair(still(np.where(SHARP > 165, 255, SHARP)), still(SHARP)), 0.5),
    "blurred": (lambda: pair(right=still(cv2.GaussianBlur(SHARP, (0, 0), 2.0))), 0.5),
    "bare": (lambda: pair(*[still(np.full((H, W), 128))] * 2), 0.5),
}


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Found]:
    """All pairs, three at a time: they are watched in real time, and mostly waited for."""
    kernel = ModelKernel({})

    def one(name: str) -> Found:
        make, seconds = PAIRS[name]
        first = 10 * list(PAIRS).index(name)
        for _ in range(3 if name == "good" else 1):  # a busy computer loses images of a good pair, too
            devices = {f"/dev/video{k}": device for k, device in enumerate(make(), first)}
            kernel.devices.update(devices)
            found = check(devices, tmp_path_factory.mktemp("pair"), seconds)
            if found["camera drops"].severity is Severity.OK:
                break
        return found

    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(3) as pool:
        patch.setattr(v4l2, "KERNEL", kernel)
        return dict(zip(PAIRS, pool.map(one, PAIRS), strict=True))


def test_a_good_pair_is_good_in_all(watched: dict[str, Found]) -> None:
    found = watched["good"]
    assert {name for name, check in found.items() if check.severity is not Severity.OK} <= {"camera stamps"}
    assert list(found) == ["cameras", "camera rate", "camera stamps", "camera drops", "camera skew", "camera exposure",
                           "camera sharpness"]  # fmt: skip
    assert "320x240 GREY" in found["cameras"].text and found["cameras"].text.count("/dev/video") == 2
    assert "20.0 Hz" in found["camera rate"].text


def test_the_skew_of_a_pair_has_a_remedy(watched: dict[str, Found]) -> None:
    skew = watched["a little apart"]["camera skew"]
    assert skew.severity is Severity.NOTE and "+3.0" in skew.text and "one signal" in skew.remedy
    found = watched["apart"]
    assert found["camera skew"].severity is Severity.FAIL and " ms apart" in found["camera skew"].text
    assert found["cameras"].severity is Severity.OK and found["cameras"].text.count("/dev/video") == 2


def test_lost_images_count(watched: dict[str, Found]) -> None:
    drops = watched["losing"]["camera drops"]
    assert drops.severity is Severity.FAIL and "lost by camera or driver" in drops.text and "USB" in drops.remedy


def test_looking_at_images_loses_none_on_a_slow_computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ratio = cameras.edge_ratio

    def slow(view: np.ndarray) -> float:
        time.sleep(0.07)
        return ratio(view)

    monkeypatch.setattr(cameras, "edge_ratio", slow)
    devices = dict(zip(("/dev/video0", "/dev/video2"), pair(), strict=True))
    monkeypatch.setattr(v4l2, "KERNEL", ModelKernel(devices))
    gone, _, all_, *_ = check(devices, tmp_path, 1.5)["camera drops"].text.partition(":")[0].split()
    assert int(gone) < 0.1 * int(all_)  # a quarter, where images are looked at as they come


def test_a_program_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(f"fx: 200\nfy: 200\ncx: 159.5\ncy: 119.5\nwidth: {W}\nheight: {H}\n")
    monkeypatch.setattr(cameras, "_PATIENCE_S", 0.5)
    monkeypatch.setenv("PATH", str(tmp_path))
    (found,) = cameras.check_cameras(f"stream:rtsp://127.0.0.1:9/a?calibration={tmp_path / 'camera.yaml'}")
    assert found.severity is Severity.FAIL and "apt install ffmpeg" in found.text and "cable" not in found.remedy


def test_a_rate_that_is_not_as_asked(watched: dict[str, Found]) -> None:
    rate = watched["slow"]["camera rate"]
    assert rate.severity is Severity.FAIL and "10.0 Hz, asked for 20" in rate.text


def test_stamps_of_another_clock_are_told(watched: dict[str, Found]) -> None:
    stamps = watched["another clock"]["camera stamps"]
    assert stamps.severity is Severity.NOTE and "count from their arrival" in stamps.text


@pytest.mark.parametrize(
    ("name", "severity", "words"),
    [
        ("dark", Severity.FAIL, "too dark"),
        ("bright", Severity.FAIL, "bright"),
        ("unequal", Severity.NOTE, "differ"),
        ("clipped", Severity.NOTE, "black or white"),
    ],
)
def test_exposure(watched: dict[str, Found], name: str, severity: Severity, words: str) -> None:
    exposure = watched[name]["camera exposure"]
    assert exposure.severity is severity and words in exposure.text and exposure.remedy


def test_a_blurred_lens_is_found_on_its_side_and_a_blank_wall_is_not_called_blurred(watched: dict[str, Found]) -> None:
    blurred = watched["blurred"]["camera sharpness"]
    assert blurred.severity is Severity.FAIL and "right one" in blurred.text and "focus" in blurred.remedy
    bare = watched["bare"]["camera sharpness"]
    assert bare.severity is Severity.NOTE and "texture" in bare.remedy


def test_sharpness_is_of_the_lens_not_of_the_scene() -> None:
    for low, high, size in ((100, 140, 12), (10, 240, 12), (60, 190, 30), (60, 190, 6)):
        image = RNG.integers(low, high, (H // size, W // size), np.uint8)
        scene = cv2.GaussianBlur(cv2.resize(image, (W, H), interpolation=cv2.INTER_NEAREST), (0, 0), 0.5)
        assert cameras.edge_ratio(scene) > cameras._SHARP
        assert cameras.edge_ratio(cv2.GaussianBlur(scene, (0, 0), 2.0)) < cameras._BLURRED


def test_a_camera_that_is_away_fails_and_says_so_as_json(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "camera.yaml").write_text(f"fx: 200\nfy: 200\ncx: 159.5\ncy: 119.5\nwidth: {W}\nheight: {H}\n")
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

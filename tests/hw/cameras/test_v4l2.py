"""V4L2 cameras on modelled devices behind the system calls: formats, stamps, pairs, faults."""

import ctypes
import errno
import platform
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_core.arrays import U8
from kiteline_core.frame import Frame
from kiteline_hw.cameras import v4l2
from kiteline_hw.cameras import v4l2_api as api
from kiteline_hw.cameras.camera import CameraError
from kiteline_hw.cameras.live_source import CameraSource
from kiteline_hw.cameras.v4l2_camera import V4l2Camera, V4l2Settings
from kiteline_hw.ports import SourceError
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.sim.sensors.video_device import ModelDevice, ModelKernel
from kiteline_hw.sources.open import open_source

W, H = 64, 48
CALIBRATION = f"fx: 50\nfy: 50\ncx: 32\ncy: 24\nwidth: {W}\nheight: {H}\n"


def view(k: int, width: int = W) -> U8:
    """A grey image that tells its number."""
    return np.full((H, width), 40 + 3 * k % 200, np.uint8) + np.arange(width, dtype=np.uint8)[None, :] % 8


def as_grey(k: int) -> bytes:
    return view(k).tobytes()


def as_yuyv(k: int) -> bytes:
    return np.stack([view(k), np.full((H, W), 128, np.uint8)], axis=2).tobytes()


def as_jpeg(k: int) -> bytes:
    return cv2.imencode(".jpg", view(k), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def device(image: Callable[[int], bytes] = as_grey, form: str = "GREY", fps: float = 50.0) -> ModelDevice:
    return ModelDevice(image, {form: [(W, H)]}, fps)


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Opens a source on modelled devices; closes it at the end."""
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    (tmp_path / "pair.yaml").write_text(CALIBRATION + "baseline_m: 0.1\n")
    sources: list[CameraSource] = []

    def open_it(
        devices: dict[str, ModelDevice], argument: str, file: str = "camera.yaml", mono: bool = False
    ) -> CameraSource:
        monkeypatch.setattr(v4l2, "KERNEL", ModelKernel(devices))
        source = open_source(f"v4l2:{argument}&calibration={tmp_path / file}", mono=mono)
        assert isinstance(source, CameraSource)
        sources.append(source)
        return source

    yield open_it
    for source in sources:
        source.close()


def frames(source: CameraSource, n: int, within_s: float = 5.0) -> list[Frame]:
    out: list[Frame] = []
    end_ns = time.monotonic_ns() + round(within_s * 1e9)
    while len(out) < n:
        frame = source.poll(end_ns)
        assert frame is not None, f"{len(out)} of {n} frames; {source.take_messages()}"
        out.append(frame)
    return out


def messages_until(source: CameraSource, word: str, within_s: float = 5.0) -> list[str]:
    """All messages up to the first that holds a word."""
    out: list[str] = []
    end_ns = time.monotonic_ns() + round(within_s * 1e9)
    while not any(word in line for line in out):
        assert time.monotonic_ns() < end_ns, out
        source.poll(time.monotonic_ns() + 10_000_000)
        out += source.take_messages()
    return out


@pytest.mark.skipif(platform.machine() not in ("x86_64", "aarch64"), reason="the numbers of 64-bit Linux")
def test_structures_have_the_sizes_of_the_kernel() -> None:
    sizes = {
        api.Capability: 104, api.Format: 208, api.PixFormat: 48, api.RequestBuffers: 20, api.Buffer: 88,
        api.StreamParameters: 204, api.FormatDescription: 64, api.FrameSize: 44, api.FrameInterval: 52,
        api.Control: 8, api.ControlQuery: 68,
    }  # fmt: skip
    assert {kind: ctypes.sizeof(kind) for kind in sizes} == sizes
    numbers = (api.QUERYCAP, api.S_FMT, api.REQBUFS, api.QUERYBUF, api.QBUF, api.DQBUF, api.STREAMON, api.S_PARM)
    assert numbers == (
        0x80685600, 0xC0D05605, 0xC0145608, 0xC0585609, 0xC058560F, 0xC0585611, 0x40045612, 0xC0CC5616,
    )  # fmt: skip
    assert (api.ENUM_FRAMESIZES, api.ENUM_FRAMEINTERVALS) == (0xC02C564A, 0xC034564B)
    assert (api.Buffer.timestamp.offset, api.Buffer.sequence.offset, api.Buffer.m.offset) == (24, 56, 64)
    assert api.Format.fmt.offset == 8


@pytest.mark.parametrize(("image", "form"), [(as_grey, "GREY"), (as_yuyv, "YUYV"), (as_jpeg, "MJPG")])
def test_pixels_stamps_and_sequence_of_each_format(opened, image, form) -> None:
    model = device(image, form)
    before_ns = time.monotonic_ns()
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50")
    got = frames(source, 6)
    steps = np.diff([frame.t_ns for frame in got])
    assert np.allclose(steps, 20e6, atol=2e3) and before_ns < got[0].t_ns < time.monotonic_ns()
    first = round((got[0].t_ns - model.begin_ns) / 20e6)
    for k, frame in enumerate(got):
        expected = view(first + k).astype(int)
        assert np.abs(frame.left.astype(int) - expected).max() <= (4 if form == "MJPG" else 0)
        assert frame.right is None
        # The log copies the camera's JPEG; raw pixels are encoded there.
        assert [image.format for image in frame.encoded] == (["jpeg"] if form == "MJPG" else [])
    assert source.report.skipped == {} and model.lost == 0


def test_rows_with_padding(opened) -> None:
    def padded(k: int) -> bytes:
        return np.hstack([view(k), np.zeros((H, 16), np.uint8)]).tobytes()

    model = device(padded)
    model.row_padding = 16
    frame = frames(opened({"/dev/video0": model}, "/dev/video0?fps=50"), 1)[0]
    assert frame.left.shape == (H, W) and int(frame.left[:, -1].max()) > 0


def test_format_exposure_gain_and_rate_are_set(opened) -> None:
    model = ModelDevice(as_yuyv, {"MJPG": [(W, H)], "YUYV": [(W, H), (32, 24)]}, 50.0)
    model.controls = {
        api.EXPOSURE_AUTO: [0, 3, 3], api.EXPOSURE_100US: [1, 5000, 157], api.GAIN: [0, 100, 0],
        api.EXPOSURE_CHANGES_RATE: [0, 1, 1],
    }  # fmt: skip
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50&exposure_ms=4.2&gain=300")
    frames(source, 1)
    assert {key: value[2] for key, value in model.controls.items()} == {
        api.EXPOSURE_AUTO: api.EXPOSURE_MANUAL, api.EXPOSURE_100US: 42, api.GAIN: 100, api.EXPOSURE_CHANGES_RATE: 0,
    }  # fmt: skip
    assert source.take_messages() == ["camera /dev/video0: 64x48 YUYV at 50 Hz, exposure 4.2 ms, gain 100"]


def test_side_by_side_images_are_cut_in_two(opened) -> None:
    model = ModelDevice(lambda k: np.hstack([view(k), view(k + 1)]).tobytes(), {"GREY": [(2 * W, H)]}, 50.0)
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50&side_by_side=1", "pair.yaml")
    frame = frames(source, 1)[0]
    first = round((frame.t_ns - model.begin_ns) / 20e6)
    assert np.array_equal(frame.left, view(first)) and np.array_equal(frame.right, view(first + 1))
    assert frame.left.flags.c_contiguous and frame.right.flags.c_contiguous


def test_two_devices_are_paired_and_their_skew_is_told(opened) -> None:
    left, right = device(), device()
    right.offset_s = 0.002
    source = opened({"/dev/video0": left, "/dev/video2": right}, "/dev/video0,/dev/video2?fps=50", "pair.yaml")
    lines = messages_until(source, "right image")
    for frame in frames(source, 5):
        assert frame.right is not None
    middle, spread = source.skew_ns
    begun_apart_ms = (right.begin_ns - left.begin_ns) / 1e6
    assert middle / 1e6 == pytest.approx(2.0 + begun_apart_ms, abs=0.05) and spread < 50_000
    assert [line for line in lines if "right image" in line and "trigger both cameras" in line]


def test_devices_too_far_apart_say_so_and_the_left_one_flies_alone(opened) -> None:
    left, right = device(fps=30.0), device(fps=30.0)
    right.offset_s = 0.014
    source = opened({"/dev/video0": left, "/dev/video2": right}, "/dev/video0,/dev/video2?fps=30", "pair.yaml")
    lines = messages_until(source, "ms apart")
    assert "the left camera flies alone; trigger both" in lines[-1]
    assert frames(source, 1)[0].right is None


def test_images_lost_by_the_driver_are_counted(opened) -> None:
    model = device()
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50")
    frames(source, 3)
    model.lose(4)
    model.damaged = 1
    frames(source, 5)
    assert source.report.skipped["image lost by camera or driver"] in (4, 5)  # the damaged one has no number to us
    assert source.report.skipped["unreadable image"] == 1
    assert not [line for line in source.take_messages() if "again" in line]  # a lost image is no outage


def test_unplugged_and_back_is_said_once_each(opened) -> None:
    model = device()
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50")
    frames(source, 3)
    source.take_messages()
    model.unplug()
    lines = messages_until(source, "unplugged")
    begin_ns = time.monotonic_ns()
    assert source.poll(begin_ns + 300_000_000) is None  # and the caller was not held longer
    assert time.monotonic_ns() - begin_ns < 400_000_000
    model.plug()
    back_ns = time.monotonic_ns()
    lines += messages_until(source, "again after")
    assert (time.monotonic_ns() - back_ns) / 1e9 < 1.2
    assert len(lines) == 2 and "plug it in again" in lines[0], lines
    frames(source, 3)
    assert source.take_messages() == [] and model.openings >= 2


@pytest.mark.parametrize(("fault", "words"), [("silence", "sends no images"), ("garbage", "cannot be used")])
def test_silence_and_garbage_are_said_once_each(opened, fault, words) -> None:
    model = device(as_jpeg, "MJPG")
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50")
    frames(source, 3)
    source.take_messages()
    getattr(model, fault)(True)
    lines = messages_until(source, "camera /dev")
    seconds, openings = (20, 3) if fault == "silence" else (3, 2)  # at most; long enough for 150 images
    end_ns = time.monotonic_ns() + seconds * 1_000_000_000
    while time.monotonic_ns() < end_ns and not (fault == "silence" and model.openings == openings):
        source.poll(time.monotonic_ns() + 50_000_000)
    lines += source.take_messages()
    getattr(model, fault)(False)
    lines += messages_until(source, "again after")
    assert len(lines) == 2 and words in lines[0] and "check its cable" in lines[0], lines
    assert model.openings >= openings


def test_one_camera_of_a_pair_goes_and_the_left_one_flies_on(opened) -> None:
    left, right = device(), device()
    source = opened({"/dev/video0": left, "/dev/video2": right}, "/dev/video0,/dev/video2?fps=50", "pair.yaml")
    frames(source, 3)
    right.unplug()
    messages_until(source, "/dev/video2 was unplugged")
    alone = frames(source, 5)
    assert all(frame.right is None for frame in alone[2:])
    right.plug()
    right.begin_ns = left.begin_ns  # cameras of one trigger
    messages_until(source, "again after")
    assert frames(source, 5)[-1].right is not None


def test_a_camera_that_comes_late_is_awaited(opened) -> None:
    model = device()
    model.plugged = False
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50")
    lines = messages_until(source, "is not there")
    assert "plug it in" in lines[0]
    model.plug()
    frames(source, 1)


def test_the_newest_frames_win(opened) -> None:
    model = device()
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50")
    frames(source, 2)
    source.take_dropped()
    time.sleep(0.3)
    frame = frames(source, 1)[0]
    assert time.monotonic_ns() - frame.t_ns < 45_000_000
    assert 11 <= source.take_dropped() <= 15 and source.take_dropped() == 0
    assert "image lost by camera or driver" not in source.report.skipped


def test_stamps_of_another_clock_are_replaced_and_said(opened) -> None:
    model = device()
    model.monotonic = False
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50")
    frame = frames(source, 1)[0]
    assert 0 <= time.monotonic_ns() - frame.t_ns < 100_000_000
    assert any("no capture times on the monotonic clock" in line for line in source.take_messages())


def test_an_image_of_another_size_is_bad(opened) -> None:
    small = cv2.imencode(".jpg", view(0)[:24, :32])[1].tobytes()
    source = opened({"/dev/video0": device(lambda k: small, "MJPG")}, "/dev/video0?fps=50")
    assert "32x24 px where the calibration says 64x48" in messages_until(source, "cannot be used")[-1]


def test_closing_wakes_who_waits_and_frees_the_device(opened) -> None:
    model = device()
    source = opened({"/dev/video0": model}, "/dev/video0?fps=50")
    frames(source, 1)
    source.close()
    assert not model.in_use and source.poll(time.monotonic_ns() + 10**10) is None
    assert list(source) == []


def test_what_cannot_be_mended_by_waiting_is_refused_at_the_start(opened, tmp_path: Path) -> None:
    wrong = ModelDevice(as_grey, {"YUYV": [(32, 24), (16, 12)]}, 50.0)
    with pytest.raises(SourceError, match=r"32x24 px in YUYV, the calibration says 64x48.*32x24, 16x12"):
        opened({"/dev/video0": wrong}, "/dev/video0?fps=50")
    with pytest.raises(SourceError, match="gives no format GREY: it offers YUYV"):
        opened({"/dev/video0": wrong}, "/dev/video0?format=grey")
    metadata = device()
    metadata.capabilities = api.CAP_STREAMING
    with pytest.raises(SourceError, match="gives no images: expected a capture node"):
        opened({"/dev/video0": metadata}, "/dev/video0?fps=50")
    locked = device()
    locked.open_error = errno.EACCES
    with pytest.raises(SourceError, match="group video"):
        opened({"/dev/video0": locked}, "/dev/video0?fps=50")
    unknown = ModelDevice(as_grey, {"H264": [(W, H)]}, 50.0)
    with pytest.raises(SourceError, match="offers H264: expected one of GREY"):
        opened({"/dev/video0": unknown}, "/dev/video0?fps=50")
    assert not any(model.in_use for model in (wrong, metadata, locked, unknown))


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("/dev/video0?speed=3", "unknown option 'speed': expected one of calibration, fps"),
        ("/dev/video0?fps=fast", "option fps='fast': expected a float"),
        ("/dev/video0?fps=0", "expected 1 to 1000"),
        ("/dev/video0?calibration=/nowhere/camera.yaml", "No such file"),
        ("a,b,c?fps=20", "expected one device, or two"),
        ("a,b?side_by_side=1", "expected one device, or two"),
        ("/dev/video0", "the camera's calibration is missing"),
    ],
)
def test_arguments_that_are_wrong(argument: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SourceError, match=words):
        open_source(f"v4l2:{argument}")


def test_a_recording_tells_the_calibration_of_a_pair(data_dir: Path, opened) -> None:
    log = data_dir / "room_flight.mcap"
    recorded = open_source(str(log))
    source = open_source(f"v4l2:/dev/none0,/dev/none1?calibration={log}")
    assert source.rig.left == recorded.rig.left and source.rig.right == recorded.rig.right
    assert np.array_equal(source.rig.T_b_c, recorded.rig.T_b_c) and source.imu is None
    source.close()


def test_a_device_that_is_busy_is_tried_again() -> None:
    model = device()
    kernel = ModelKernel({"/dev/video0": model})
    first, second = (V4l2Camera("/dev/video0", V4l2Settings(W, H, 50.0), kernel) for _ in range(2))
    first.open()
    with pytest.raises(CameraError, match="used by another program") as error:
        second.open()
    assert error.value.passing
    first.close()
    assert second.open() == "/dev/video0: 64x48 GREY at 50 Hz"
    model.damaged = 1
    with pytest.raises(BadImage, match="damaged"):
        second.read(1.0)
    second.close()


def test_a_file_is_no_camera(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(CameraError, match="is no video device"):
        V4l2Camera(str(tmp_path / "file"), V4l2Settings(W, H), api.LinuxKernel()).open()
    with pytest.raises(CameraError, match="is not there"):
        V4l2Camera(str(tmp_path / "none"), V4l2Settings(W, H), api.LinuxKernel()).open()

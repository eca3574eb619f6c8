"""Files that mean harm: only SourceError or BadImage comes of them, soon and in little memory."""

import json
import math
import struct
import time
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zstandard

from kiteline_core.frame import EncodedImage
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.calibration.files import read_calibration
from kiteline_hw.logs.mcap_file import MAGIC, MOST_CHUNK_BYTES, McapFile
from kiteline_hw.logs.mcap_log import LogReader, LogWriter
from kiteline_hw.logs.rig_json import rig_from_json, rig_to_json
from kiteline_hw.ports import SourceError
from kiteline_hw.sensors.image_size import size_of
from kiteline_hw.sensors.images import decode_depth, decode_grey
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.sources import euroc, tum
from kiteline_hw.sources.text_files import read_yaml, seconds_to_ns
from kiteline_hw.system.memory import rss_mib
from tests.yardstick import slowness

RIG = CameraRig(CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5), None, np.eye(4), None)


def png(width: int, height: int, bits: int = 8, colour: int = 0, rows: bytes = b"") -> bytes:
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    )
    chunks = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def test_images_are_measured_before_they_are_decoded() -> None:
    before = rss_mib()
    for data in (png(30_000, 30_000), png(1 << 30, 1 << 30), png(0, 5), png(1 << 14, 1 << 13)):
        with pytest.raises(BadImage, match="px: expected at most"):
            decode_grey(EncodedImage(data, "png"))
    with pytest.raises(BadImage, match="16-bit grey"):
        decode_depth(EncodedImage(png(4000, 4000, 16, 6), "png/1000"))  # eight bytes a pixel
    assert rss_mib() - before < 64


def test_a_png_that_ends_before_its_image_is_not_decoded() -> None:
    """The decoder goes on behind the end: a chunk there took 4 GiB and ten seconds."""
    sound, end = png(64, 64), struct.pack(">I", 0) + b"IEND" + bytes(4)
    header = sound[: sound.index(b"IDAT") - 4]
    for data in (header + end + struct.pack(">I", 1 << 28) + b"IDAT" + bytes(64), header + end):
        with pytest.raises(BadImage):
            decode_grey(EncodedImage(data, "png"))
        assert size_of(data) is None
    assert size_of(sound) == (64, 64)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp", ".pgm", ".ppm", ".tiff", ".webp"])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_size_of_each_format_is_known_from_its_head(ending: str, channels: int) -> None:
    image = np.random.default_rng(0).integers(0, 255, (37, 61, channels)).astype(np.uint8)
    if channels == 1 and ending == ".ppm":
        ending = ".pgm"
    ok, data = cv2.imencode(ending, image if channels == 3 else image[..., 0])
    if not ok:
        pytest.skip(f"this OpenCV writes no {ending}")
    assert size_of(data.tobytes()) == (61, 37)
    for cut in range(0, min(60, len(data)), 3):
        size_of(data.tobytes()[:cut])


def chunk_file(path: Path, packed: bytes, size: int, compression: str = "zstd") -> Path:
    name = compression.encode()
    body = struct.pack("<QQQII", 1, 2, size, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    path.write_bytes(MAGIC + struct.pack("<BQ", 6, len(body)) + body)
    return path


@pytest.fixture(scope="module")
def bomb() -> bytes:
    """600 MiB of zeros in a few kB."""
    return zstandard.ZstdCompressor().compress(bytes(600 << 20))


@pytest.mark.parametrize("size", [64, MOST_CHUNK_BYTES, 1 << 30, (1 << 64) - 1])
def test_a_bomb_in_a_chunk_is_cut_at_what_it_claims(tmp_path: Path, bomb: bytes, size: int) -> None:
    before, begin_s = rss_mib(), time.process_time()
    log = McapFile(chunk_file(tmp_path / "bomb.mcap", bomb, size))
    assert list(log.messages()) == []
    assert rss_mib() - before < 100
    assert log.notes
    assert time.process_time() - begin_s < 2.0 * slowness()  # each zero was read as a record: 7 s


def test_lengths_that_lie_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    for opcode in range(1, 16):
        for length in (0, 3, 1 << 31, 1 << 62, (1 << 64) - 1):
            record = struct.pack("<BQ", opcode, length)
            path.write_bytes(MAGIC + record + b"abc" + MAGIC)
            list(McapFile(path).messages())
    footer = struct.pack("<BQQQI", 2, 20, 1 << 62, 1 << 62, 0)
    path.write_bytes(MAGIC + struct.pack("<BQI", 15, 4, 0) + footer + MAGIC)
    list(McapFile(path).messages())


def test_json_too_deep_is_a_damaged_log(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", {}) as log:
        log._write("/deep", 1, "kiteline.Json", (b"[" * 100_000,), {})
    with LogReader(tmp_path / "a.mcap") as read, pytest.raises(SourceError, match="no JSON"):
        next(iter(read.messages())).json()


@pytest.mark.parametrize(
    "line", ["a:" + " " * 40_000 + "[", "a: !!" + " " * 40_000 + "[", "a: [\n" * 9_000, " " * 40_000 + "a b: 1"]
)
def test_yaml_takes_no_time_to_refuse(tmp_path: Path, line: str) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(line + "\nrate_hz: 20\nT_BS:\n  data: [1, 0,\n   0, 1]\n")
    begin = time.process_time()
    table = read_yaml(path, "anything")
    assert time.process_time() - begin < 1.0 * slowness()
    assert table["rate_hz"] == "20" and table["T_BS.data"] == [1.0, 0.0, 0.0, 1.0]


def test_aliases_do_not_multiply_in_an_error(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [" + ", ".join([f"*a{i - 1}"] * 9) + "]" for i in range(1, 12)]
    path = tmp_path / "calibration.yaml"
    path.write_text("\n".join([*lines, "kiteline_calibration: *a11"]) + "\n")
    begin = time.process_time()
    with pytest.raises(SourceError):
        read_calibration(str(path))
    assert time.process_time() - begin < 1.0 * slowness()


def euroc_folder(root: Path, listing: str) -> Path:
    folder = root / "flight"
    (folder / "mav0" / "cam0" / "data").mkdir(parents=True)
    (root / "secret.png").write_bytes(png(4, 4, rows=bytes(20)))
    (folder / "mav0" / "cam0" / "data.csv").write_text(listing)
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(
        "sensor_type: camera\nT_BS:\n  rows: 4\n  cols: 4\n  data: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]\n"
        "rate_hz: 20\nresolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [50, 50, 31.5, 23.5]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
    )
    return folder


@pytest.mark.parametrize("name", ["../../../../secret.png", "/etc/passwd", "a/../../../b.png", "a\0b.png"])
def test_a_listing_names_only_files_of_its_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(SourceError, match="is no file in"):
        euroc.open_source(str(euroc_folder(tmp_path, f"1,{name}\n")), True, False)
    folder = tmp_path / "rgbd"
    folder.mkdir()
    (folder / "rgb.txt").write_text(f"1.0 {name}\n")
    with pytest.raises(SourceError, match="is no file in"):
        tum.open_source(str(folder), True, False)


@pytest.mark.parametrize("stamp", ["9" * 5000, "9" * 19, "²", "-1", "1e3"])
def test_stamps_beyond_64_bits_are_refused(tmp_path: Path, stamp: str) -> None:
    with pytest.raises(SourceError, match="expected 't_ns,filename'"):
        euroc.open_source(str(euroc_folder(tmp_path, f"{stamp},a.png\n")), True, False)


@pytest.mark.parametrize("text", ["1e999999999", "1e20", "-1e400000", "nan", "1" * 5000])
def test_seconds_beyond_64_bits_are_refused(text: str) -> None:
    begin = time.process_time()
    with pytest.raises(ValueError, match="no time in seconds"):
        seconds_to_ns(text)
    assert time.process_time() - begin < 0.5 * slowness()


@pytest.mark.parametrize(
    "change",
    [{"fx": math.nan}, {"fx": -50.0}, {"fy": 0.0}, {"cx": math.inf}, {"width": 1 << 20}, {"height": -4},
     {"distortion": [math.nan, 0.0, 0.0, 0.0]}, {"readout_s": -1.0}],
)  # fmt: skip
def test_the_rig_of_a_log_is_checked_like_any_calibration(change: dict[str, Any]) -> None:
    value = json.loads(json.dumps(rig_to_json(RIG, None)))
    value["left"] |= change
    with pytest.raises(SourceError):
        rig_from_json(value)


@pytest.mark.parametrize("pose", [np.full((4, 4), np.nan), np.zeros((4, 4)), np.diag([2.0, 2.0, 2.0, 1.0])])
def test_poses_of_a_logged_rig_are_rigid(pose: np.ndarray[Any, Any]) -> None:
    value = json.loads(json.dumps(rig_to_json(RIG, None)))
    with pytest.raises(SourceError):
        rig_from_json({**value, "T_b_c": pose.tolist()})
    with pytest.raises(SourceError):
        rig_from_json({**value, "T_c_r": pose.tolist()})


def test_a_sound_rig_is_read_to_the_last_bit() -> None:
    pose = np.eye(4)
    pose[0, 3] = 0.1 + 1e-16
    rig = replace(RIG, right=RIG.left, T_c_r=pose)
    again, imu = rig_from_json(json.loads(json.dumps(rig_to_json(rig, None))))
    assert imu is None and again.T_c_r is not None
    assert again.T_c_r.tobytes() == pose.tobytes() and again.left == rig.left


@pytest.mark.parametrize("claimed", [1 << 24, 1 << 31, (1 << 32) - 1])
def test_a_chunk_of_a_png_that_claims_gigabytes_is_refused_before_it_takes_them(claimed: int) -> None:
    """77 bytes took 4 GiB and two seconds."""
    data = bytearray(cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes())
    at = data.index(b"IDAT") - 4
    data[at : at + 4] = claimed.to_bytes(4, "big")
    assert size_of(bytes(data)) is None
    with pytest.raises(BadImage, match="are cut or damaged"):
        decode_grey(EncodedImage(bytes(data), "png"))

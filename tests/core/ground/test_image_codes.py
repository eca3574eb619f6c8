"""Coded images of scans: the same images but for what JPEG rounds, and no memory for what is no such code."""

import struct
import time

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_core.arrays import U8
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.disparity import DisparityCamera
from kiteline_core.ground.image_codes import decode_pair, encode_pair

CAMERA = DisparityCamera.of(RectifiedCamera(320, 240, 200.0, 200.0, 159.5, 119.5, 0.1, True, np.eye(4)))


def pair() -> tuple[U8, U8]:
    noise = np.random.default_rng(1).integers(0, 256, (2, CAMERA.height, CAMERA.width)).astype(np.uint8)
    left, right = (np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), np.uint8) for image in noise)
    return left, right


def test_images_come_back_each_in_its_place() -> None:
    left, right = pair()
    code = encode_pair((left, right), 90)
    read = decode_pair(code, CAMERA)
    assert read is not None and len(code) < left.size
    for given_image, image in zip((left, right), read, strict=True):
        assert image.dtype == np.uint8 and image.flags.c_contiguous
        error = image.astype(np.float64) - given_image
        assert np.abs(error).mean() < 1.5 and abs(error.mean()) < 0.2
    assert len(encode_pair((left, right), 60)) < len(code)


def test_images_of_another_camera_are_none() -> None:
    code = encode_pair(pair(), 90)
    other = DisparityCamera.of(RectifiedCamera(640, 240, 200.0, 200.0, 159.5, 119.5, 0.1, True, np.eye(4)))
    assert decode_pair(code, other) is None


def with_size(code: bytes, rows: int, columns: int) -> bytes:
    at = code.index(b"\xff\xc0")
    return code[: at + 5] + struct.pack(">HH", rows, columns) + code[at + 9 :]


def test_an_image_that_claims_another_size_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    code = encode_pair(pair(), 90)
    assert decode_pair(with_size(code, 2 * CAMERA.height, CAMERA.width), CAMERA) is not None
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("memory was taken"))
    assert decode_pair(with_size(code, 65535, 65535), CAMERA) is None
    frame = code[code.index(b"\xff\xc0") : code.index(b"\xff\xc0") + 2 + 11]
    assert decode_pair(code[:2] + frame + code[2:], CAMERA) is None  # which of the two sizes counts?


@pytest.mark.parametrize("progressive", [0, 1])
def test_thousands_of_passes_over_an_image_are_not_decoded(progressive: int) -> None:
    """Those of a progressive image took 300 times as long as one."""
    grey = np.full((2 * CAMERA.height, CAMERA.width), 128, np.uint8)
    code = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
    last, end = code.rindex(b"\xff\xda"), code.rindex(b"\xff\xd9")
    many = code[:end] + code[last:end] * ((200_000 - len(code)) // (end - last)) + code[end:]
    decode_pair(code, CAMERA)
    once = min(timed(code) for _ in range(5))
    assert min(timed(many) for _ in range(3)) < 20 * once + 0.005


def timed(code: bytes) -> float:
    begin_s = time.process_time()
    decode_pair(code, CAMERA)
    return time.process_time() - begin_s


@given(st.binary(max_size=64), st.integers(0, 700), st.integers(0, 3))
def test_any_bytes_are_images_of_that_size_or_none(junk: bytes, at: int, how: int) -> None:
    code = encode_pair(pair(), 50)
    at = min(at, len(code))
    spoilt = (junk, code[:at], code[:at] + junk + code[at + len(junk) :], code[:at] + junk)[how]
    read = decode_pair(spoilt, CAMERA)
    assert read is None or all(image.shape == (CAMERA.height, CAMERA.width) for image in read)

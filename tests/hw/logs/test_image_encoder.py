"""Raw images of a log: encoded apart, in order, never lost."""

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_core.arrays import U8
from kiteline_core.frame import EncodedImage, Frame
from kiteline_hw.logs import image_encoder
from kiteline_hw.logs.image_encoder import EncodingPolicy, ImageEncoder
from kiteline_hw.logs.mcap_log import LEFT, RIGHT, LogReader, LogWriter
from kiteline_hw.sensors.images import decode_grey, encode_image, store_image


def picture(seed: int, shape: tuple[int, int] = (48, 75)) -> U8:
    noise = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (5, 5), 1.5), np.uint8)


def flown(path: Path, policy: EncodingPolicy, stores: bool = False) -> ImageEncoder:
    encoder = ImageEncoder(policy)
    encoder.stores = stores
    with LogWriter(path, {}, encoder=encoder) as log:
        for k in range(10):
            log.json("/step", k, {"k": k})
            log.frame(Frame(k, picture(k), picture(100 + k)))
            log.blob("/packets", k, b"%d" % k)
    return encoder


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> threading.Semaphore:
    """The encoder's thread encodes an image for each permit."""
    permits = threading.Semaphore(0)

    def encode(pixels: U8) -> EncodedImage:
        permits.acquire()
        return encode_image(pixels)

    monkeypatch.setattr(image_encoder, "encode_image", encode)
    return permits


def check(path: Path) -> None:
    with LogReader(path) as log:
        found = list(log.messages())
        assert [m.topic for m in found] == ["/step", LEFT, RIGHT, "/packets"] * 10
        for k in range(10):
            left, right = (decode_grey(m.image())[0] for m in found[4 * k + 1 : 4 * k + 3])
            assert np.array_equal(left, picture(k))
            assert np.array_equal(right, picture(100 + k))


def test_messages_keep_their_order_whatever_the_encoder_takes(tmp_path: Path, slow: threading.Semaphore) -> None:
    late = threading.Timer(0.3, slow.release, (20,))
    late.start()
    flown(tmp_path / "a.mcap", EncodingPolicy(most_waiting=100))
    check(tmp_path / "a.mcap")
    slow.release(20)
    flown(tmp_path / "b.mcap", EncodingPolicy(most_waiting=2))
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_a_lagging_encoder_stores_images_and_loses_none(tmp_path: Path, slow: threading.Semaphore) -> None:
    late = threading.Timer(0.3, slow.release, (20,))
    late.start()
    encoder = flown(tmp_path / "a.mcap", EncodingPolicy(most_waiting=6), stores=True)
    assert encoder.stored == 14
    check(tmp_path / "a.mcap")


def test_stored_images_are_plain_png(tmp_path: Path) -> None:
    encoder = flown(tmp_path / "a.mcap", EncodingPolicy(compressed=False))
    assert encoder.stored == 0
    check(tmp_path / "a.mcap")
    image = store_image(picture(3))
    assert np.array_equal(cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED), picture(3))
    assert len(encode_image(picture(3, (480, 752))).data) < 0.9 * len(store_image(picture(3, (480, 752))).data)

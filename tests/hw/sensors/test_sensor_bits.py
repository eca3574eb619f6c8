"""Grey images in words of 16 bits, of which a camera fills 10, 12 or 14: scaled by these, packed or not."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from kiteline_core.frame import EncodedImage
from kiteline_hw.sensors.images import ImageRef, decode_grey
from kiteline_hw.sensors.raw_pixels import RawPixels
from kiteline_hw.sensors.sensor_bits import SensorBits, bits_of_grey

U16 = np.uint16


def raw(words: np.ndarray) -> ImageRef:
    return RawPixels(words.shape[1], words.shape[0], "mono16", 0, words.astype("<u2").tobytes())


def packed(kind: str) -> Callable[[np.ndarray], ImageRef]:
    def image(words: np.ndarray) -> ImageRef:
        pixels = np.dstack([words] * 3) if kind == "colour" else words
        suffix = "png" if kind == "colour" else kind
        return EncodedImage(cv2.imencode(f".{suffix}", pixels)[1].tobytes(), suffix)

    return image


KINDS = {"raw": raw, "png": packed("png"), "png, colour": packed("colour"), "tiff": packed("tiff")}


@pytest.mark.parametrize("of", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize(("brightest", "bits"), [(1023, 10), (3000, 12), (16383, 14), (50000, 16)])
def test_a_camera_that_fills_some_bits_is_not_dark(
    of: Callable[[np.ndarray], ImageRef], brightest: int, bits: int
) -> None:
    words = np.linspace(0, brightest, 24 * 32).reshape(24, 32).astype(U16)
    grey = SensorBits()
    pixels, encoded = grey.decode(of(words))
    assert grey.bits == bits
    np.testing.assert_allclose(pixels, words >> (bits - 8), atol=1)
    if encoded is not None:  # what a log keeps is decoded without what this flight knew of the camera
        assert np.array_equal(decode_grey(encoded)[0], pixels)
    assert (encoded is None) == (bits < 16 or of is raw)
    note = grey.take_note()
    assert note is None if bits == 16 else note is not None and f"hold {bits} bits" in note
    assert grey.take_note() is None


def test_bits_only_rise_and_stay_after_the_first_images() -> None:
    grey, dim = SensorBits(), np.full((4, 4), 600, U16)
    assert grey.decode(raw(np.zeros((4, 4), U16)))[0][0, 0] == 0 and grey.bits == 16
    assert grey.decode(raw(dim))[0][0, 0] == 150
    assert grey.decode(raw(np.full((4, 4), 3000, U16)))[0][0, 0] == 187
    assert grey.decode(raw(dim))[0][0, 0] == 37
    for _ in range(60):
        grey.decode(raw(dim))
    assert grey.decode(raw(np.full((4, 4), 65535, U16)))[0][0, 0] == 255 and grey.bits == 12


def test_images_of_8_bits_are_kept_as_they_came() -> None:
    image = EncodedImage(cv2.imencode(".png", np.full((4, 4), 9, np.uint8))[1].tobytes(), "png")
    assert SensorBits().decode(image)[1] is image
    assert bits_of_grey([[image]]) == (16, ())


def test_a_recording_is_looked_at_before_it_is_read() -> None:
    packed_12 = packed("png")(np.full((4, 4), 2000, U16))
    bits, notes = bits_of_grey([[packed("png")(np.full((4, 4), 600, U16)), packed_12], [packed_12]])
    assert bits == 12 and len(notes) == 1
    assert SensorBits(bits).decode(packed("png")(np.full((4, 4), 600, U16)))[0][0, 0] == 37

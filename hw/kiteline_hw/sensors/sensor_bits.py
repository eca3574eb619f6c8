"""How many bits of 16-bit grey images a camera fills: no message or file says it, and 10 of 16 taken as 16 are nearly
black.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from itertools import islice

import numpy as np

from kiteline_core.arrays import U8
from kiteline_core.frame import EncodedImage
from kiteline_hw.sensors.images import ImageRef, decode_grey, decode_words, read_encoded
from kiteline_hw.sensors.raw_pixels import SENSOR_BITS, BadImage, RawPixels, grey_of_words

_LOOKED_AT = 60  # images: two or three seconds, in which an automatic exposure settles
_MOST_BITS = 16


class SensorBits:
    """Decodes grey images, and scales those of 16 bits by the fewest bits that hold the brightest pixel so far.

    After 60 such images the bits stay; both cameras of a pair share them.
    """

    def __init__(self, bits: int | None = None) -> None:
        """bits: where they are known; None: they are found."""
        self.bits = _MOST_BITS if bits is None else bits
        self._brightest = 0
        self._images_left = _LOOKED_AT if bits is None else 0
        self._told_bits = self.bits

    def decode(self, ref: ImageRef) -> tuple[U8, EncodedImage | None]:
        """Grey pixels (h,w), and the encoded image of which `decode_grey` makes the same; None without one.

        Raises BadImage.
        """
        if isinstance(ref, RawPixels):
            self._note(ref.brightest())
            return replace(ref, bits=self.bits).grey(), None
        image = read_encoded(ref)
        words = decode_words(image) if self._images_left or self.bits < _MOST_BITS else None
        if words is None:
            return decode_grey(image)
        self._note(int(words.max()))
        return decode_grey(image) if self.bits == _MOST_BITS else (grey_of_words(words, self.bits), None)

    def take_note(self) -> str | None:
        """What is to be told of the bits since the last call."""
        if self.bits == self._told_bits:
            return None
        self._told_bits = self.bits
        return f"images in words of 16 bits hold {self.bits} bits, by their brightest pixel: scaled by these"

    def look_at(self, images: Iterable[ImageRef]) -> None:
        """Find the bits by the first images of a camera before any is decoded."""
        for image in islice(images, _LOOKED_AT):
            words = None
            with suppress(BadImage):
                words = image.brightest() if isinstance(image, RawPixels) else _brightest(read_encoded(image))
            if words is None:
                break
            self._images_left = _LOOKED_AT
            self._note(words)
        self._images_left = 0

    def _note(self, brightest: int | None) -> None:
        if brightest is None or not self._images_left:
            return
        self._images_left -= 1
        self._brightest = max(self._brightest, brightest)
        if self._brightest:
            self.bits = next(bits for bits in SENSOR_BITS if self._brightest < 1 << bits)


def bits_of_grey(cameras: Iterable[Iterable[ImageRef]]) -> tuple[int, tuple[str, ...]]:
    """The bits by the first images of all cameras of a recording, 16 for other layouts; notes."""
    grey = SensorBits()
    for images in cameras:
        grey.look_at(images)
    note = grey.take_note()
    return grey.bits, () if note is None else (note,)


def _brightest(image: EncodedImage) -> int | None:
    words = decode_words(image)
    return None if words is None else int(np.max(words))

"""How many bits of mono16 images a camera fills: no message says it, and 10 of 16 taken as 16 are nearly black."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from itertools import islice

from kiteline_core.frame import EncodedImage
from kiteline_hw.sensors.raw_pixels import SENSOR_BITS, BadImage, RawPixels

_LOOKED_AT = 60  # images: two or three seconds, in which an automatic exposure settles


def bits_of_grey(cameras: Iterable[Iterable[EncodedImage | RawPixels]]) -> tuple[int, tuple[str, ...]]:
    """The fewest bits that hold the brightest pixel of the first images of all cameras, 16 for other layouts; notes."""
    brightest: int | None = None
    for images in cameras:
        for image in islice(images, _LOOKED_AT):
            found = None
            with suppress(BadImage):
                found = image.brightest() if isinstance(image, RawPixels) else None
            if found is None:
                break
            brightest = max(brightest or 0, found)
    if not brightest:
        return 16, ()
    bits = next(bits for bits in SENSOR_BITS if brightest < 1 << bits)
    return bits, (f"mono16 images hold {bits} bits, by their brightest pixel: scaled by these",) if bits < 16 else ()

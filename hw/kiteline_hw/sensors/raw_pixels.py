"""Uncompressed images of ROS and Foxglove messages, and their conversion to grey values or metres."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_core.arrays import F32, U8, U16

_TO_GREY = {
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8uc3": (3, cv2.COLOR_BGR2GRAY),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "8uc4": (4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
    "uyvy": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuyv": (2, cv2.COLOR_YUV2GRAY_YUY2),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2GRAY_YUY2),
}
_GREY = ("mono8", "8uc1")
_GREY16 = {"mono16": None, "mono10": 10, "mono12": 12, "mono14": 14}  # in words of 16 bits; bits where the name says
SENSOR_BITS = (10, 12, 14, 16)  # of cameras whose pixels are in words of 16
DEPTH_ENCODINGS = ("16uc1", "32fc1")  # ROS REP 118: millimetres; metres


class BadImage(Exception):
    """An image that cannot be used; the text says why. Raised only in this package: sources count it as skipped."""


def grey_of_words(words: U16, bits: int) -> U8:
    """Grey values (h, w) of 8 bits from the lowest `bits` of words of 16; brighter ones are clipped."""
    return np.asarray(np.minimum(words >> (bits - 8), 255), np.uint8)


@dataclass(frozen=True, slots=True)
class RawPixels:
    """Pixels in rows of `step` bytes. encoding: ROS's name of the pixel layout, such as mono8, bgr8, 16UC1.

    bits: how many of the 16 of mono16 the camera fills, from the lowest on.
    """

    width: int
    height: int
    encoding: str
    step: int
    data: bytes
    big_endian: bool = False
    bits: int = 16

    @property
    def is_depth(self) -> bool:
        """True if the pixels are distances."""
        return self.encoding.lower() in DEPTH_ENCODINGS

    def grey(self) -> U8:
        """(h, w) uint8. Raises BadImage."""
        name = self.encoding.lower()
        if name in _GREY:
            return np.ascontiguousarray(self._rows(np.uint8, 1))
        if name in _GREY16:
            return grey_of_words(self._rows(np.uint16, 1), _GREY16[name] or self.bits)
        if name not in _TO_GREY:
            known = ", ".join((*_GREY, *_GREY16, *_TO_GREY))
            raise BadImage(f"pixel encoding {self.encoding!r} is not known: expected one of {known}")
        channels, code = _TO_GREY[name]
        pixels = np.ascontiguousarray(self._rows(np.uint8, channels))
        if channels > 1:
            pixels = pixels.reshape(self.height, self.width, channels)
        return np.asarray(cv2.cvtColor(pixels, code), np.uint8)

    def brightest(self) -> int | None:
        """The largest value of mono16; None for other layouts. Raises BadImage."""
        return int(self._rows(np.uint16, 1).max()) if self.encoding.lower() == "mono16" else None

    def metres(self) -> F32:
        """(h, w) float32, 0 unknown. Raises BadImage."""
        if self.encoding.lower() == "16uc1":
            return self._rows(np.uint16, 1).astype(np.float32) * np.float32(1e-3)
        if self.encoding.lower() == "32fc1":
            depth = self._rows(np.float32, 1)
            return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0).astype(np.float32)
        raise BadImage(f"depth encoding {self.encoding!r} is not known: expected 16UC1 or 32FC1")

    def _rows(self, dtype: type[np.generic], channels: int) -> NDArray[Any]:
        kind = np.dtype(dtype).newbyteorder(">" if self.big_endian else "<")
        row_bytes = self.width * channels * kind.itemsize
        step = self.step or row_bytes
        if self.width <= 0 or self.height <= 0 or step < row_bytes or len(self.data) < step * self.height:
            raise BadImage(
                f"{len(self.data)} bytes in rows of {step} for {self.width}x{self.height} px of {self.encoding}"
            )
        rows = np.frombuffer(self.data, np.uint8, step * self.height).reshape(self.height, step)[:, :row_bytes]
        return np.ascontiguousarray(rows).view(kind)

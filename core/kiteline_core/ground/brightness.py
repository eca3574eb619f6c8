"""Brightness of a stereo pair: cameras differ in gain, and lenses darken to the corners, so a point has two greys.

Semi-global matching compares greys. On plain ground it moves a disparity until the greys agree, and where lenses
darken that is somewhere else: a low camera's floor got points up to 3 m below it. Both numbers are learned from pairs
that were matched, and the next pair is matched without them.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from kiteline_core.arrays import F32, F64, U8

_EVERY = 4  # pixels of which one is compared
_DARK, _BRIGHT = 15, 240  # greys between which an image is neither noise nor saturated
_UNSATURATED, _TOP = 0.995, 250.0  # share of pixels that stay below this grey: white corners would be plain
_LEAST = 200  # pixels that tell
_ROUNDS = 4  # of reweighting
_LEAST_SIGMA = 0.01  # of a grey's logarithm: noise of images
_KEPT = 0.8  # of what is known, when another pair is added: exposures of cameras drift apart
_STIFFNESS = 1e-5  # for each pixel: what holds the power at 0 where disparities are too small to tell it
_MOST_POWER, _MOST_GAIN = 6.0, 0.7  # cos^4 is that of a simple lens; the logarithm of 2


@dataclass(frozen=True, slots=True)
class Brightness:
    """Differences in brightness of a pair's cameras.

    gain: natural logarithm of left over right. power: of the cosine of the angle to the optical axis, by which both
    images darken. sums: a00, a01, a11, b0, b1 of the normal equations of gain and power.
    """

    gain: float = 0.0
    power: float = 0.0
    sums: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def evened(self, pair: tuple[U8, U8], falloff: F32) -> tuple[U8, U8]:
        """Both images (h,w) as lenses that do not darken would show them, of equal gain. falloff: see `falloff`."""
        brighter = np.exp(np.float32(self.power) * falloff)
        brighter *= np.float32(np.exp(-0.5 * self.gain))
        some = (pair[0][::_EVERY, ::_EVERY] * brighter[::_EVERY, ::_EVERY]).ravel()
        at = int(_UNSATURATED * (some.size - 1))
        brighter *= np.float32(min(1.0, _TOP / max(float(np.partition(some, at)[at]), 1.0)))
        left = cv2.multiply(pair[0], brighter, dtype=cv2.CV_8U)
        right = cv2.multiply(pair[1], brighter, scale=float(np.exp(self.gain)), dtype=cv2.CV_8U)
        return np.asarray(left, np.uint8), np.asarray(right, np.uint8)

    def learned(self, pair: tuple[U8, U8], disparity: F32, falloff: F32) -> "Brightness":
        """What is known with another pair (h,w) as it was taken, and its disparities (h,w) in px, 0 unknown."""
        found, left = disparity[::_EVERY, ::_EVERY], pair[0][::_EVERY, ::_EVERY]
        h, w = disparity.shape
        at = np.arange(0, w, _EVERY) - found
        first = np.floor(at).astype(np.int64)
        seen = (found > 0.0) & (first >= 0) & (first + 1 < w)
        part = at - first
        index = np.clip(first, 0, w - 2) + w * np.arange(0, h, _EVERY)[:, None]  # of the right image, and the next
        right = (1.0 - part) * pair[1].take(index) + part * pair[1].take(index + 1)
        seen &= (left > _DARK) & (left < _BRIGHT) & (right > _DARK) & (right < _BRIGHT)
        if np.count_nonzero(seen) < _LEAST:
            return self
        index, part = index[seen], part[seen]
        there = (1.0 - part) * falloff.take(index) + part * falloff.take(index + 1)
        darker = there - falloff[::_EVERY, ::_EVERY][seen]  # logarithm of left over right for a power of 1
        ratio = np.log(left[seen].astype(np.float64) / right[seen])
        return self._with(ratio, np.asarray(darker, np.float64))

    def _with(self, ratio: F64, darker: F64) -> "Brightness":
        """Add observed (n,) logarithms of left over right, robustly."""
        x, total = np.array([_median(ratio - self.power * darker), self.power]), np.zeros(5)
        kept, squared, product = _KEPT * np.array(self.sums), darker**2, darker * ratio
        for _ in range(_ROUNDS):
            error = ratio - x[0] - x[1] * darker
            sigma = max(1.48 * _median(np.abs(error)), _LEAST_SIGMA)
            w = 1.0 / (1.0 + (0.5 * error / sigma) ** 2) ** 2
            total = kept + (w.sum(), w @ darker, w @ squared, w @ ratio, w @ product)
            a00, a01, a11, b0, b1 = total.tolist()
            x = np.linalg.solve([[a00, a01], [a01, a11 + _STIFFNESS * a00]], [b0, b1])
        gain, power = np.clip(x, (-_MOST_GAIN, 0.0), (_MOST_GAIN, _MOST_POWER)).tolist()
        a00, a01, a11, b0, b1 = total.tolist()
        return Brightness(gain, power, (a00, a01, a11, b0, b1))


def _median(values: F64) -> float:
    """That of numpy, in a third of its time: selected once."""
    middle = len(values) // 2
    parted = np.partition(values, middle)
    upper = float(parted[middle])
    return upper if len(values) % 2 else 0.5 * (float(parted[:middle].max()) + upper)


def falloff(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> F32:
    """Negative logarithm (h,w) of the cosine of the angle between a pixel's ray and the optical axis."""
    x, y = (np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy
    return np.asarray(0.5 * np.log1p(x[None] ** 2 + y[:, None] ** 2), np.float32)

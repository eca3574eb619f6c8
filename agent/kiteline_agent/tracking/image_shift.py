"""Corrects a bad prediction by the shift and the roll of a small blurred image since the last tracked frame.

After G. Klein and D. Murray, "Improving the agility of keyframe-based SLAM" (2008), with phase correlation in place of
their alignment. It finds the large shifts of a quick rotation, which template alignment cannot.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from kiteline_agent.imaging.features import Pyramid
from kiteline_core.arrays import F32, F64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier

_LEVEL = 3  # 94x60 px for 752x480: shifts of up to half the image are found
_SURE_RESPONSE = 0.5  # height above which the image has hardly rolled
_ROLLS_RAD = (-0.42, -0.28, -0.14, 0.14, 0.28, 0.42)  # rolls that are tried then
_MOST, _LEAST_SHARE = 3, 0.5  # rotations that are told at most, with so much of the best one's height
_MIN_RESPONSE = 0.05  # height of the correlation peak; below it the two images have nothing in common


class ImageShift:
    """The small image of the last tracked frame, with its pose."""

    def __init__(self, rectifier: Rectifier) -> None:
        self._rectifier, self._camera = rectifier, rectifier.camera
        self._image: U8 | None = None
        self._T_c_m = np.eye(4)
        self._hanning: F32 | None = None

    def remember(self, left: Pyramid, T_c_m: F64) -> None:
        """Keep the image of a frame that was tracked at T_c_m (4,4). left: its pyramid as it came."""
        self._image, self._T_c_m = left[min(_LEVEL, len(left) - 1)], T_c_m

    def rotated_poses(self, left: Pyramid) -> list[F64]:
        """T_c_m (4,4) of a frame if its image differs by a pure rotation, the likeliest first.

        Where the camera rolled and moved, several rolls correlate about as well. Empty if the images do not match.
        """
        level = min(_LEVEL, len(left) - 1)
        if self._image is None or self._image.shape != left[level].shape:
            return []
        if self._hanning is None:
            h, w = self._image.shape
            self._hanning = np.asarray(cv2.createHanningWindow((w, h), cv2.CV_32F), np.float32)
        before, now = (self._rectifier.left_level(i, level).astype(np.float32) for i in (self._image, left[level]))
        before -= before.mean()
        now -= now.mean()
        found = [_correlate(before, now, 0.0, self._hanning)]
        if found[0].response < _SURE_RESPONSE:
            found += [_correlate(before, now, roll, self._hanning) for roll in _ROLLS_RAD]
            found.sort(key=lambda each: -each.response)
        least = max(_MIN_RESPONSE, _LEAST_SHARE * found[0].response)
        return [self._rotated(each, float(1 << level)) for each in found[:_MOST] if each.response >= least]

    def _rotated(self, found: "_Correlation", px: float) -> F64:
        """T_c_m (4,4) after the rotation that a correlation tells. px: pixels of the camera in one of its images."""
        x, y = px * found.shift_px[0] / self._camera.fx, px * found.shift_px[1] / self._camera.fy
        rotation = se3.so3_exp(np.array([-y, x, 0.0])) @ se3.so3_exp(np.array([0.0, 0.0, found.roll_rad]))
        return se3.from_rt(rotation, np.zeros(3)) @ self._T_c_m


@dataclass(frozen=True, slots=True)
class _Correlation:
    """How an image lies to the one before it: rotated about its centre, then shifted by (x, y). response: 0 to 1."""

    roll_rad: float
    shift_px: tuple[float, float]
    response: float


def _correlate(before: F32, now: F32, roll_rad: float, window: F32) -> _Correlation:
    """The shift between two images (h,w) of zero mean, the first one rotated by an angle."""
    if roll_rad != 0.0:
        h, w = before.shape
        about = cv2.getRotationMatrix2D((0.5 * (w - 1), 0.5 * (h - 1)), -float(np.degrees(roll_rad)), 1.0)
        before = np.asarray(cv2.warpAffine(before, about, (w, h), borderMode=cv2.BORDER_REPLICATE), np.float32)
    (x, y), response = cv2.phaseCorrelate(before, now, window)
    return _Correlation(roll_rad, (x, y), response)

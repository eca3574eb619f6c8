"""Corrects a bad prediction by the shift of a small blurred image since the last tracked frame.

After G. Klein and D. Murray, "Improving the agility of keyframe-based SLAM" (2008), with phase correlation in place of
their alignment. It finds the large shifts of a quick rotation, which template alignment cannot.
"""

import cv2
import numpy as np

from kiteline_agent.imaging.features import Pyramid
from kiteline_core.arrays import F32, F64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier

_LEVEL = 3  # 94x60 px for 752x480: shifts of up to half the image are found
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

    def rotated_pose(self, left: Pyramid) -> F64 | None:
        """T_c_m (4,4) of a frame if its image shift is a pure rotation; None if the images do not match."""
        level = min(_LEVEL, len(left) - 1)
        if self._image is None or self._image.shape != left[level].shape:
            return None
        if self._hanning is None:
            h, w = self._image.shape
            self._hanning = np.asarray(cv2.createHanningWindow((w, h), cv2.CV_32F), np.float32)
        before, now = (self._rectifier.left_level(i, level).astype(np.float32) for i in (self._image, left[level]))
        (dx, dy), response = cv2.phaseCorrelate(before - before.mean(), now - now.mean(), self._hanning)
        if response < _MIN_RESPONSE:
            return None
        scale = float(1 << level)
        rotation = se3.so3_exp(np.array([-dy * scale / self._camera.fy, dx * scale / self._camera.fx, 0.0]))
        return se3.from_rt(rotation, np.zeros(3)) @ self._T_c_m

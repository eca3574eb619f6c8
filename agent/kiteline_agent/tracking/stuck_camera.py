"""Detects a camera that repeats its last image while the vehicle moves."""

import numpy as np

from kiteline_core.arrays import F64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera

_ROW_STEP = 16  # every 16th row of an image is compared: sensor noise makes no two of them alike
_MIN_REPEATS = 2  # some drivers fill a gap with a single repetition
_MIN_SHIFT_PX = 2.0  # expected image shift since the image was new; a noise-free camera at rest repeats itself, too
_DEPTH_M = 4.0  # assumed depth, to convert translation into image shift


class StuckCamera:
    """Compares each image with the one before; call `update` once a frame."""

    def __init__(self, camera: RectifiedCamera) -> None:
        self._focal_px = camera.fx
        self._rows = np.zeros((0, 0), np.uint8)
        self._T_o_c: F64 = np.eye(4)  # predicted when the image was new
        self._repeats = 0

    @property
    def repeated(self) -> bool:
        """True if the last image equals the one before."""
        return self._repeats > 0

    def update(self, left: U8, T_o_c: F64) -> bool:
        """True if image (h,w) is an old one although the camera should be at T_o_c (4,4) by now."""
        rows = left[::_ROW_STEP]
        middle = len(rows) // 2  # tells most images apart by itself
        same = rows.shape == self._rows.shape and np.array_equal(rows[middle], self._rows[middle])
        if not (same and np.array_equal(rows, self._rows)):
            self._rows, self._T_o_c, self._repeats = rows.copy(), T_o_c.copy(), 0
            return False
        self._repeats += 1
        T = se3.inverse(self._T_o_c) @ T_o_c
        angle = float(np.linalg.norm(se3.so3_log(T[:3, :3])))
        shift_px = self._focal_px * (angle + float(np.linalg.norm(T[:3, 3])) / _DEPTH_M)
        return self._repeats >= _MIN_REPEATS and shift_px > _MIN_SHIFT_PX

"""A camera that repeats its last image while the vehicle moves on: such an image is no sight of where it is now."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera

F64 = NDArray[np.float64]

_ROWS = 16  # every so many rows of an image are compared: noise makes no two of them alike
_REPEATS = 2  # a single repetition is how some drivers fill gaps
_MOVED_PX = 2.0  # by which the view must have shifted meanwhile; a camera without noise repeats itself at rest
_DEPTH_M = 4.0  # of a view, to tell shifts from motion


class StuckCamera:
    """Once a frame `repeats`."""

    def __init__(self, camera: RectifiedCamera) -> None:
        self._focal_px = camera.fx
        self._rows = np.zeros((0, 0), np.uint8)
        self._T_o_c: F64 = np.eye(4)  # where the image was new
        self._repeats = 0

    @property
    def repeated(self) -> bool:
        """Whether the last image was the one before."""
        return self._repeats > 0

    def repeats(self, left: NDArray[np.uint8], T_o_c: F64) -> bool:
        """Whether an image (h,w) is old though the camera should be at T_o_c (4,4) by now."""
        rows = left[::_ROWS]
        if not np.array_equal(rows, self._rows):
            self._rows, self._T_o_c, self._repeats = rows.copy(), T_o_c.copy(), 0
            return False
        self._repeats += 1
        T = se3.inverse(self._T_o_c) @ T_o_c
        turned = float(np.linalg.norm(se3.so3_log(T[:3, :3])))
        shifted_px = self._focal_px * (turned + float(np.linalg.norm(T[:3, 3])) / _DEPTH_M)
        return self._repeats >= _REPEATS and shifted_px > _MOVED_PX

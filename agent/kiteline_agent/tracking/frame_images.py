"""What is rectified of a pair: the left image, the right where somebody looks; at half size if need be."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import StereoConfig
from kiteline_agent.imaging.features import Pyramid, build_pyramid
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.imaging import stereo_kernels

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

_RECTIFIED = np.zeros((0, 0, 2), np.float32)  # no way back to a raw image is needed


def rectified(image: U8, rectifier: Rectifier, eye: int, levels: int, first: int) -> Pyramid:
    """The pyramid of the rectified image of an eye (0 left, 1 right). first: its finest level, 0 or 1.

    With 1 the work is a third; level 0 is then blank, so that nothing is found on it.
    """
    if first == 0 or not rectifier.bends:
        return build_pyramid(rectifier.rectify(eye, image), levels)
    return (rectifier.blank, *build_pyramid(rectifier.half(eye, image), levels - 1))


class RightImage:
    """One right image (h, w) uint8, as the lens made it. Raises CalibrationError when its size is not the left's.

    offset_px: what disparities at pixels (n,2) are measured too large by (n,), as far as is known; it is taken off.
    """

    def __init__(
        self, image: U8, rectifier: Rectifier, levels: int, offset_px: Callable[[F64], F64] | None = None
    ) -> None:  # fmt: skip
        rectifier.check_size(image)
        self._image = image
        self._rectifier = rectifier
        self._levels = levels
        self._offset_px = offset_px
        self._raw: Pyramid | None = None
        self._coarse: Pyramid | None = None

    def coarse(self) -> Pyramid:
        """The pyramid of the rectified image, in which level 0 may be blank."""
        if self._coarse is None:
            raw = self._pyramid()
            self._coarse = raw
            if self._rectifier.bends:
                half = self._rectifier.halved(1, raw[1])
                self._coarse = (self._rectifier.blank, *build_pyramid(half, self._levels - 1))
        return self._coarse

    def refine(
        self, left: Pyramid, uv: F64, octave: U8, sure: NDArray[np.bool_], config: StereoConfig, search_px: float,
        disparity: F64, found: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        """stereo_kernels.refine_rows, of true disparities; only what is looked at is rectified."""
        grid = self._rectifier.right_grid
        wanted = disparity >= 0.0
        off = np.zeros(len(uv)) if self._offset_px is None else self._offset_px(uv)
        disparity[wanted] = np.maximum(disparity[wanted] + off[wanted], 0.0)
        stereo_kernels.refine_rows(
            left, self._pyramid(), _RECTIFIED if grid is None else grid, uv, octave, sure, config.iterations, search_px,
            config.min_ncc, disparity, found,
        )  # fmt: skip
        disparity[wanted] = np.maximum(disparity[wanted] - off[wanted], 0.0)

    def _pyramid(self) -> Pyramid:
        """Of the image as the lens made it."""
        if self._raw is None:
            self._raw = build_pyramid(self._image, self._levels)
        return self._raw

"""Image pyramids of one frame, rectified only where they are read."""

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from kiteline_agent.config import PyramidConfig
from kiteline_agent.imaging import stereo_kernels
from kiteline_agent.imaging.features import Pyramid, build_pyramid
from kiteline_agent.imaging.raw_grid import NO_GRID, grid_for_kernels
from kiteline_core.arrays import F32, F64, U8, Bool
from kiteline_core.frame import Frame
from kiteline_core.geometry.cameras import Rectifier

_MIN_NCC = 0.85  # correlation of the two patches; lower at occlusions and depth edges
_ITERATIONS = 6  # Gauss-Newton steps; it converges in 3


class RightImage:
    """One right image (h, w) uint8, not rectified. Raises CalibrationError when its size is not the left's."""

    def __init__(
        self, image: U8, rectifier: Rectifier, levels: int, offset_px: Callable[[F64], F64] | None = None
    ) -> None:
        """offset_px: known error (n,) of measured disparities at pixels (n,2); it is subtracted."""
        rectifier.check_size(image)
        self._image = image
        self._rectifier = rectifier
        self._levels = levels
        self._offset_px = offset_px
        self._raw: Pyramid | None = None
        self._coarse: Pyramid | None = None

    @property
    def needs_rectification(self) -> bool:
        """True if the rectified image differs from the raw one."""
        return self._rectifier.remaps

    def coarse(self) -> Pyramid:
        """Pyramid of the rectified image; level 0 is blank if it needs rectification or is read at other rows."""
        if self._coarse is None:
            raw = self.raw()
            self._coarse = raw
            if self._rectifier.remaps or self._rectifier.right_rows is not None:
                half = self._rectifier.halved(1, raw[1])
                self._coarse = (self._rectifier.blank, *build_pyramid(half, self._levels - 1))
        return self._coarse

    def rectified(self) -> Pyramid:
        """Pyramid of the whole image, rectified as calibrated."""
        return build_pyramid(self._rectifier.right(self._image), self._levels)

    def rows_changed(self) -> None:
        """The rectifier reads other rows than before."""
        self._coarse = None

    def raw_half(self) -> U8:
        """Level 1 of the image as it came, alone."""
        return np.asarray(cv2.pyrDown(self._image), np.uint8) if self._raw is None else self._raw[1]

    def refine(
        self, left: Pyramid, left_grid: F32, uv: F64, octave: U8, sure: Bool, slopes: F64, search_px: float,
        disparity: F64, found: Bool,
    ) -> None:  # fmt: skip
        """Measure disparities to sub-pixel (stereo_kernels.refine_rows); rectifies only the patches that it reads."""
        wanted = disparity >= 0.0
        offset = np.zeros(len(uv)) if self._offset_px is None else self._offset_px(uv)
        np.maximum(disparity + offset, 0.0, out=disparity, where=wanted)
        stereo_kernels.refine_rows(
            left, left_grid, self.raw(), grid_for_kernels(self._rectifier.right_grid), uv, octave, sure, slopes,
            _ITERATIONS, search_px, _MIN_NCC, disparity, found,
        )  # fmt: skip
        np.maximum(disparity - offset, 0.0, out=disparity, where=wanted)

    def raw(self) -> Pyramid:
        """Pyramid of the image as it came."""
        if self._raw is None:
            self._raw = build_pyramid(self._image, self._levels)
        return self._raw


@dataclass(slots=True)
class FrameImages:
    """Images of one frame.

    sampled: pyramid of the left one: rectified, or raw where `grid` is its grid of raw pixels and not NO_GRID.
    depth_m: (h,w) float32 aligned with left, or None. first: finest level in use. rectifier: of raw images.
    """

    sampled: Pyramid
    right: RightImage | None
    depth_m: F32 | None
    first: int = 0
    grid: F32 = field(default_factory=lambda: NO_GRID)
    rectifier: Rectifier | None = None
    _left: Pyramid | None = field(default=None, init=False)
    _coarse: Pyramid | None = field(default=None, init=False)

    @property
    def left(self) -> Pyramid:
        """Pyramid of the whole rectified left image, for corners and descriptors; made on demand: most frames are read
        at few places. Level 0 is blank if it is not in use.
        """
        if self._left is None:
            if self.rectifier is None:
                self._left = self.sampled
            elif self.first:
                self._left = (self.rectifier.blank, *self._halves(self.rectifier))
            else:
                self._left = build_pyramid(self.rectifier.rectify(0, self.sampled[0]), len(self.sampled))
        return self._left

    @property
    def aligned(self) -> Pyramid:
        """The whole level 0, and coarser levels rectified at half size, as the right image's: for templates."""
        return self.left if self.rectifier is None else (self.left[0], *self._halves(self.rectifier))

    def rectified_by(self, rectifier: Rectifier) -> "FrameImages":
        """The same frame, read through a rectifier after `correct_left`."""
        assert rectifier.left_grid is not None
        return FrameImages(self.sampled, self.right, self.depth_m, self.first, rectifier.left_grid, rectifier)

    def raw_half(self) -> U8:
        """Level 1 of the left image as it came."""
        return self.sampled[1]

    def half(self) -> U8:
        """Level 1 of the rectified left image."""
        return self.sampled[1] if self.rectifier is None else self._halves(self.rectifier)[0]

    def _halves(self, rectifier: Rectifier) -> Pyramid:
        """Level 1 of the raw pyramid, rectified, and its coarser levels."""
        if self._coarse is None:
            self._coarse = build_pyramid(rectifier.halved(0, self.sampled[1]), len(self.sampled) - 1)
        return self._coarse

    @property
    def rectified_px(self) -> int:
        """Pixels that were rectified, but for single patches."""
        if self.rectifier is None:
            return 0
        whole = 0 if self._left is None or self.first else self.sampled[0].size
        return whole + (0 if self._coarse is None else self.sampled[1].size)


def frame_images(
    frame: Frame, rectifier: Rectifier, config: PyramidConfig, first: int, offset_px: Callable[[F64], F64]
) -> FrameImages:
    """Images of a frame. first: finest level wanted, 0 or 1. offset_px: see RightImage.

    Raises CalibrationError for an image of the wrong size.
    """
    right = None if frame.right is None else RightImage(frame.right, rectifier, config.levels, offset_px)
    depth_m = None if frame.depth_m is None else rectifier.depth(frame.depth_m)
    rectifier.check_size(frame.left)
    pyramid, grid = build_pyramid(frame.left, config.levels), rectifier.left_grid
    if grid is None:
        return FrameImages(pyramid, right, depth_m)
    return FrameImages(pyramid, right, depth_m, first, grid, rectifier)


def depth_at(depth_m: F32, uv: F64) -> F64:
    """Depth (n,) in m at pixels (n,2); 0 where unknown or where the 3x3 neighbourhood is an edge (spread above 5 %)."""
    h, w = depth_m.shape
    x = np.clip(np.round(uv[:, 0]).astype(np.int64), 1, w - 2)
    y = np.clip(np.round(uv[:, 1]).astype(np.int64), 1, h - 2)
    around = np.stack([depth_m[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]).astype(np.float64)
    low, high = around.min(axis=0), around.max(axis=0)
    sure = (low > 0.0) & (high - low < 0.05 * low)
    return np.where(sure, np.median(around, axis=0), 0.0)

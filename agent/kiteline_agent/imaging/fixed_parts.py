"""Finds image cells that show what moves with the camera: parts of the vehicle, text of a video link.

The strongest edge of each block is compared between two frames of a camera that has turned. An edge of the
surroundings has moved across itself by pixels; one that is where it was, again and again, is fixed in the image.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_core.arrays import F32, F64, I64, U8, Bool
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import GRID_STEP, RectifiedCamera

_BLOCK, _CELL = 8, 2  # pixels of the half image in a block, and blocks in a cell: 16 and 32 px of the whole one
CELL_PX = 2 * _BLOCK * _CELL
_EDGE = 64.0  # least strength of an edge, 8 grey levels a pixel: weaker ones are those of noise and soft shadows
_MOVED_PX = 8.0  # px by which an edge of the surroundings has moved across itself: four of the half image
_ALIKE, _RATIO = 0.9, 1.7  # cosine of the directions and ratio of the strengths of an edge that is where it was
_TELLING = 0.2  # share of the edges that tell; with fewer the older frame waits for more motion
_FIRST_LOOKS, _RARER = 24, 5.0  # after so many looks they are so many times rarer while nothing is found
_BY_CHANCE = 3  # cells that may be found where nothing is fixed
_EVERY_S = 0.3  # s between two looks at first, at least: each takes a quarter of a millisecond
_LONGEST_S = 3.0  # s between the two frames: then a new pair begins
_FROZEN = 0.5  # share of the edges that are where they were: the image is an old one, or the pose is wrong
_MEMORY = 0.92  # factor on what is known of a block with each pair of frames that tells of it
_LEAST = 4.5  # least weight of these pairs for a fixed block: that of six, two seconds of turning
_SHARE, _RELEASED = 0.5, 0.25  # share of the pairs with a still edge above which a block is fixed, and remains so
_BORDER_PX = 2.0  # px of the raw image's border that interpolation reaches
_MOST = 0.5  # share of all cells: where more stand still, something else is wrong


@dataclass(frozen=True, slots=True)
class FixedPartsConfig:
    """Parts of the image that stand still while the camera turns."""

    on: bool = True  # False: only what `detector.covered` names is left out


@dataclass(slots=True)
class _Look:
    """The gradient (h,w) of a frame at half size, and the camera T_o_c (4,4)."""

    t_ns: int
    T_o_c: F64
    x: NDArray[np.int16]
    y: NDArray[np.int16]


class FixedParts:
    """Call `look` with frames that have a pose and are due; `cells` tells what stands still."""

    def __init__(self, camera: RectifiedCamera, config: FixedPartsConfig, covered: F64, grid: F32 | None) -> None:
        """covered: (n,4) left, top, right, bottom of parts that are left out anyway, in shares of the image.

        grid: (gh,gw,2) raw pixels of every GRID_STEP-th one; None if the image needs no rectification.
        """
        self._camera = camera
        self._config = config
        self._shape = camera.height // 2 // _BLOCK, camera.width // 2 // _BLOCK
        n = self._shape[0] * self._shape[1]
        self._seen, self._same, self._fixed = np.zeros(n), np.zeros(n), np.zeros(n, np.bool_)
        rows, columns = (-(-blocks // _CELL) for blocks in self._shape)
        self.cells: Bool = np.zeros((rows, columns), np.bool_)
        self._before: _Look | None = None
        self._looks = 0
        free = np.ones(self._shape, np.bool_)
        for left, top, right, bottom in covered * ([camera.width, camera.height] * 2) / (2.0 * _BLOCK):
            free[int(top) : math.ceil(bottom), int(left) : math.ceil(right)] = False
        if grid is not None:
            free &= _shown(grid, self._shape, np.array([camera.width, camera.height]))
        self._free = free.ravel()

    def interrupt(self) -> None:
        """The motion since the last look is unknown."""
        self._before = None

    def is_due(self, t_ns: int, T_o_c: F64) -> bool:
        """True if a frame of a camera at T_o_c (4,4) tells more than the last one that was looked at."""
        before = self._before
        if before is None:
            return self._config.on
        age_s = (t_ns - before.t_ns) * 1e-9
        every_s = _EVERY_S * (1.0 if self._looks < _FIRST_LOOKS or int(self.cells.sum()) > _BY_CHANCE else _RARER)
        return age_s >= every_s and (self._turned_px(before, T_o_c) >= _MOVED_PX or age_s > _LONGEST_S)

    def look(self, t_ns: int, half: U8, T_o_c: F64, depths_m: F64) -> bool:
        """Compare the edges of a frame with those of an earlier one. True if other cells stand still now.

        half: (h,w) rectified left image at half size. T_o_c: (4,4) camera. depths_m: (n,) of what it sees.
        """
        self._looks += 1
        x, y = (np.asarray(part, np.int16) for part in cv2.spatialGradient(half))
        before, now = self._before, _Look(t_ns, T_o_c.copy(), x, y)
        if before is None or not len(depths_m) or self._turned_px(before, T_o_c) < _MOVED_PX:
            self._before = now
            return False
        compared = self._compare(before, now, se3.inverse(T_o_c) @ before.T_o_c, float(depths_m.min()))
        if compared is not None or (t_ns - before.t_ns) * 1e-9 > _LONGEST_S:
            self._before = now
        return compared is True and self._update_cells()

    def _turned_px(self, before: _Look, T_o_c: F64) -> float:
        return self._camera.fx * float(np.linalg.norm(se3.so3_log(T_o_c[:3, :3].T @ before.T_o_c[:3, :3])))

    def _compare(self, before: _Look, now: _Look, T_c_b: F64, nearest_m: float) -> bool | None:
        """Count edges that tell: surroundings would have moved. None if they are too few; False if most are still."""
        at = self._strongest(before)
        a, b = (np.stack([look.x.reshape(-1)[at], look.y.reshape(-1)[at]]).astype(np.float64) for look in (before, now))
        size_a, size_b = np.hypot(*a), np.hypot(*b)
        edge, moved = self._free & (size_a > _EDGE), self._moved_px(at, T_c_b, nearest_m, a / np.maximum(size_a, 1.0))
        tells = edge & (moved > _MOVED_PX)
        if int(np.count_nonzero(tells)) < max(_TELLING * int(np.count_nonzero(edge)), 1):
            return None
        alike = tells & ((a * b).sum(axis=0) > _ALIKE * size_a * size_b)
        alike &= (size_b * _RATIO > size_a) & (size_b < size_a * _RATIO)
        if int(np.count_nonzero(alike)) > _FROZEN * int(np.count_nonzero(tells)):
            return False
        tells |= self._fixed & ~edge  # what stood there is gone
        self._seen[tells] = _MEMORY * self._seen[tells] + 1.0
        self._same[tells] = _MEMORY * self._same[tells] + alike[tells]
        share = np.where(self._fixed, _RELEASED, _SHARE)
        self._fixed = (self._seen > _LEAST) & (self._same > share * self._seen)
        return True

    def _strongest(self, look: _Look) -> I64:
        """Index (n,) of the strongest edge's pixel in each block."""
        (rows, columns), width = self._shape, look.x.shape[1]
        strength = (np.abs(look.x) + np.abs(look.y))[: rows * _BLOCK, : columns * _BLOCK]
        row, column = (part.ravel() for part in np.indices(self._shape))
        highest = strength.reshape(rows, _BLOCK, -1).max(axis=1)  # of the rows of blocks, by column
        x = column * _BLOCK + highest.reshape(rows, columns, _BLOCK).argmax(axis=2).ravel()
        y = row * _BLOCK + strength.reshape(rows, _BLOCK, -1)[row, :, x].argmax(axis=1)
        return np.asarray(y * width + x)

    def _moved_px(self, at: I64, T_c_b: F64, nearest_m: float, across: F64) -> F64:
        """px by which surroundings at pixels (n,) have moved along unit vectors (2,n), at least, at any depth."""
        camera, (v, u) = self._camera, np.divmod(at, -(-self._camera.width // 2))
        ray = np.stack([(2.0 * u - camera.cx) / camera.fx, (2.0 * v - camera.cy) / camera.fy, np.ones(len(at))])
        moved = []
        for rho in (0.0, 1.0 / nearest_m):  # at any depth between these the motion is between theirs
            p = T_c_b[:3, :3] @ ray + T_c_b[:3, 3:] * rho
            step = (p[:2] / np.maximum(p[2], 0.1) - ray[:2]) * [[camera.fx], [camera.fy]]
            moved.append((step * across).sum(axis=0))
        return np.where(moved[0] * moved[1] > 0.0, np.minimum(np.abs(moved[0]), np.abs(moved[1])), 0.0)

    def _update_cells(self) -> bool:
        """Leave out cells with two fixed blocks side by side. True if they have changed."""
        fixed = self._fixed.reshape(self._shape)
        around = cv2.boxFilter(fixed.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        sure = fixed & (around > 1.5)
        cells = np.zeros_like(self.cells)
        row, column = np.nonzero(sure)
        cells[row // _CELL, column // _CELL] = True
        if np.count_nonzero(cells) > _MOST * cells.size or np.array_equal(cells, self.cells):
            return False
        self.cells = cells
        return True


def _shown(grid: F32, shape: tuple[int, int], size: I64) -> Bool:
    """Blocks (rows, columns) that lie in the raw image, with those around: at its end, rectification makes an edge."""
    inside = np.asarray(((grid > _BORDER_PX) & (grid < size - 1.0 - _BORDER_PX)).all(axis=2), np.uint8)
    step = 2 * _BLOCK // GRID_STEP  # points of the grid in a block
    whole = cv2.erode(inside, np.ones((3 * step, 3 * step), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(whole[step // 2 :: step, step // 2 :: step][: shape[0], : shape[1]] == 1)

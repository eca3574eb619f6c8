"""A rectifier's grid of raw pixels, as kernels take it (`rectification_kernels`)."""

import numpy as np

from kiteline_core.arrays import F32

NO_GRID = np.zeros((0, 0, 2), np.float32)  # the image needs no rectification


def grid_for_kernels(grid: F32 | None) -> F32:
    """`Rectifier.left_grid` or `right_grid` (h,w,2), px; NO_GRID where it has none."""
    return NO_GRID if grid is None else grid

"""Surfaces that are thinner than a matched block: they get their own disparity, not that of the wall behind."""

import cv2
import numpy as np

from kiteline_core.arrays import U8
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityCamera, DisparityStripes

CAMERA = DisparityCamera.of(RectifiedCamera(752, 480, 400.0, 400.0, 375.5, 239.5, 0.11, True, np.eye(4)))
H, W = CAMERA.height, CAMERA.width
WALL_PX, SLAB_PX = 4, 11
ROWS, COLUMNS = slice(70, 73), slice(120, 260)  # of the slab in the left image


def pair_with_slab(seed: int) -> tuple[U8, U8]:
    """A textured wall and a slab of three rows before it, with noise."""
    rng = np.random.default_rng(seed)
    wall, slab = (cv2.GaussianBlur(rng.normal(0.0, 60.0, (H, W + 48)), (0, 0), 1.2) + 120.0 for _ in range(2))
    left, right = wall[:, :W].copy(), wall[:, WALL_PX : W + WALL_PX].copy()
    left[ROWS, COLUMNS] = slab[ROWS, COLUMNS]
    right[ROWS, COLUMNS.start - SLAB_PX : COLUMNS.stop - SLAB_PX] = slab[ROWS, COLUMNS]
    images = [np.clip(image + rng.normal(0.0, 1.5, image.shape), 0.0, 255.0).round() for image in (left, right)]
    return images[0].astype(np.uint8), images[1].astype(np.uint8)


def test_a_thin_slab_is_not_taken_for_the_wall_behind() -> None:
    stripes = DisparityStripes(CAMERA, GroundConfig())
    stripes.begin_reduced(pair_with_slab(1))
    disparity = stripes.measure_begun()
    slab = disparity[ROWS, COLUMNS][:, 10:-10]
    known = slab[slab > 0.0]
    assert known.size > 0.5 * slab.size
    assert (np.abs(known - SLAB_PX) < 1.5).mean() > 0.9
    beside = np.concatenate([disparity[8:60, 60:-8], disparity[84:-8, 60:-8]])
    assert (np.abs(beside - WALL_PX) < 1.5).mean() > 0.98

"""Surfaces that are thinner than a matched block: they get their own disparity, not that of the wall behind."""

import cv2
import numpy as np

from kiteline_core.arrays import F32, U8
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityCamera, DisparityStripes
from kiteline_core.ground.level_kernels import correct_thin_surfaces

CAMERA = DisparityCamera.of(RectifiedCamera(752, 480, 400.0, 400.0, 375.5, 239.5, 0.11, True, np.eye(4)))
H, W = CAMERA.height, CAMERA.width
WALL_PX, SLAB_PX, MOST_PX = 4, 11, 48
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


def corrected(left: U8, right: U8, disparity: F32) -> F32:
    """What `correct_thin_surfaces` does, pixel by pixel."""
    h, w = left.shape
    out, half = disparity.copy(), 4
    errors, found = np.zeros((h, w), np.float32), {}
    for v, u in np.argwhere(disparity > 0.0):
        at = np.float32(u) - disparity[v, u]
        i = int(np.floor(at))
        if 0 <= i < w - 1:
            a, b = np.float32(right[v, i]), np.float32(right[v, i + 1])
            errors[v, u] = abs(np.float32(left[v, u]) - (a + (at - np.float32(i)) * (b - a)))
    for v, u in np.argwhere(disparity > 0.0):
        if not half <= u < w - half:
            continue
        seen = slice(u - half, u + half + 1)
        error = np.cumsum(errors[v, seen])[-1]
        if error <= 4.0 * (2 * half + 1):
            continue
        least = np.ceil(min(0.5 * error, 3.0 * (2 * half + 1)))
        for q in range(int(disparity[v, u] + 1.5) + 1, min(MOST_PX, u - half + 1)):
            moved = right[v, u - half - q : u + half + 1 - q]
            other = np.abs(left[v, seen].astype(int) - moved.astype(int)).sum()
            if other < least:
                least, found[v, u] = other, q
    for at_px, q in found.items():
        out[at_px] = q
    lonely = [
        (v, u)
        for (v, u), q in found.items()
        if (np.abs(out[max(v - 1, 0) : v + 2, max(u - half, 0) : u + half + 1] - q) <= 1.0).sum() - 1 < 15
    ]
    for at_px in lonely:
        out[at_px] = 0.0
    return out


def test_the_kernel_agrees_with_numpy() -> None:
    """Disparities of a wall, of which a tenth is wrong and a fifth unknown."""
    left, right = (image[40:100, 80:240].copy() for image in pair_with_slab(2))
    rng = np.random.default_rng(3)
    disparity = np.where(rng.random(left.shape) < 0.1, rng.uniform(0.5, 30.0, left.shape), WALL_PX).astype(np.float32)
    disparity[rng.random(left.shape) < 0.2] = 0.0
    expected, rows = corrected(left, right, disparity), np.empty((4, left.shape[1]), np.int16)
    best, least, lowest, difference = rows
    changed = correct_thin_surfaces(
        left, right, MOST_PX, disparity, np.empty((2, left.shape[1]), np.float32), best, least, lowest, difference,
        np.empty(left.size, np.int32), np.empty(left.size, np.float32),
    )  # fmt: skip
    assert changed > 100 and np.any(expected == 0.0)
    np.testing.assert_array_equal(disparity, expected)

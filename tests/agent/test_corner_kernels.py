"""FAST corners: those of OpenCV, in free cells only."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from kiteline_agent.imaging import corner_kernels


def noise(seed: int, rows: int, columns: int) -> NDArray[np.uint8]:
    """Grey noise, smoothed so far that it has corners of all strengths."""
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.standard_normal((rows, columns)), (0, 0), 1.3)
    return np.asarray(np.clip(128 + 50 * image / image.std(), 0, 255), np.uint8)


def by_opencv(image: NDArray[np.uint8], threshold: int, margin: int) -> NDArray[np.int32]:
    found = cv2.FastFeatureDetector.create(threshold, True).detect(image)
    xy = np.array(cv2.KeyPoint.convert(found), np.float32).astype(np.int32)
    limit = np.array([image.shape[1], image.shape[0]]) - margin
    return xy[((xy >= margin) & (xy < limit)).all(axis=1)]


@pytest.mark.parametrize(("rows", "columns", "margin"), [(90, 121, 20), (64, 80, 5), (41, 43, 18), (30, 200, 20)])
@pytest.mark.parametrize("threshold", [7, 12, 40])
def test_the_corners_of_opencv(rows: int, columns: int, margin: int, threshold: int) -> None:
    image = noise(rows + threshold, rows, columns)
    free = np.zeros((1, 1), np.bool_)
    xy = np.empty((image.size // 4, 2), np.int32)
    n = corner_kernels.fast_corners(image, threshold, margin, 1, 1000.0, free, xy)
    np.testing.assert_array_equal(xy[:n], by_opencv(image, threshold, margin))


def test_no_corner_in_an_occupied_cell_and_none_beyond_the_buffer() -> None:
    image = noise(1, 100, 140)
    cell_px, scale = 32.0, 2  # cells of 16 px of this level
    occupied = np.random.default_rng(2).random((7, 9)) < 0.5
    xy = np.empty((image.size // 4, 2), np.int32)
    n = corner_kernels.fast_corners(image, 12, 18, scale, cell_px, occupied, xy)
    every = by_opencv(image, 12, 18)
    cells = (every * scale / cell_px).astype(int)
    np.testing.assert_array_equal(xy[:n], every[~occupied[cells[:, 1], cells[:, 0]]])
    assert 10 < n < len(every)
    few = np.empty((5, 2), np.int32)
    assert corner_kernels.fast_corners(image, 12, 18, scale, cell_px, occupied, few) == 5
    np.testing.assert_array_equal(few, xy[:5])

"""Corners are followed in changing light, and images that show none of them are left out, though not for ever."""

import cv2
import numpy as np
import pytest

from kiteline_agent.imaging.optical_flow import Flow, as_bright_as, follow
from kiteline_agent.initialisation.frame_flow import BadImages
from kiteline_core.arrays import U8

FLOW = Flow(window_px=15, return_px=0.5)
SHIFT = (5, 3)  # px, right and down


def views() -> tuple[U8, U8]:
    """Two views of a textured plane, (240,320); corners move by SHIFT from the first to the second."""
    scene = cv2.GaussianBlur(np.random.default_rng(1).normal(110.0, 140.0, (260, 340)), (0, 0), 2.0)
    scene = scene.clip(0.0, 255.0).astype(np.uint8)
    x, y = SHIFT
    return np.ascontiguousarray(scene[10:250, 10:330]), np.ascontiguousarray(scene[10 - y : 250 - y, 10 - x : 330 - x])


def grid() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(20.0, 300.0, 20.0), np.arange(20.0, 220.0, 20.0)), 2).reshape(-1, 2)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.6, 0.0), (1.5, 0.0), (0.7, 40.0), (1.0, -25.0)])
def test_corners_are_followed_whatever_the_exposure(gain: float, offset: float) -> None:
    before, after = views()
    lit = (gain * after.astype(np.float64) + offset).clip(0.0, 255.0).astype(np.uint8)
    for guess in (None, grid() + 0.7 * np.array(SHIFT)):
        found, good = follow(before, lit, grid(), FLOW, guess=guess)
        assert good.mean() > 0.95
        assert np.median(np.abs(found[good] - grid()[good] - SHIFT)) < 0.05


def test_corners_keep_from_the_border_and_return_to_where_they_were() -> None:
    before, after = views()
    uv = np.array([[6.0, 100.0], [100.0, 3.0], [316.0, 100.0], [160.0, 120.0]])
    assert follow(before, after, uv, FLOW)[1].tolist() == [True, False, False, True]  # 11 px from it, 6, out of it
    assert follow(before, after, uv, Flow(window_px=15, border_px=4.0))[1].tolist() == [True, True, False, True]
    other = np.ascontiguousarray(after[::-1, ::-1])  # nothing of it is in the first view
    kept = follow(before, other, grid(), FLOW)[1].mean()
    assert kept < 0.3 and kept < 0.5 * follow(before, other, grid(), Flow(window_px=15))[1].mean()


def test_an_image_in_the_same_light_is_left_as_it_is() -> None:
    before, after = views()
    assert as_bright_as(before, after) is after
    dark = (0.5 * after).astype(np.uint8)
    assert np.abs(as_bright_as(before, dark).astype(np.float64) - after).mean() < 2.0
    for plain in (np.zeros_like(after), np.full_like(after, 90)):
        assert as_bright_as(before, plain) is plain and as_bright_as(plain, after) is after


def test_blank_images_are_left_out_a_few_in_a_row() -> None:
    blank, shown, none = BadImages(3), np.arange(10) < 1, np.zeros(10, np.bool_)
    assert [blank.leaves_out(found) for found in (shown, none, none, shown, none)] == [False, True, True, False, True]
    assert [blank.leaves_out(none) for _ in range(5)] == [True, True, False, True, True]
    assert not blank.leaves_out(np.zeros(0, np.bool_))

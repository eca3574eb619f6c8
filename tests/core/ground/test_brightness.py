"""Brightness of a pair: what gain and falloff are learned from matches, and that the next match is free of them."""

import cv2
import numpy as np
import pytest

from kiteline_core.arrays import F32, U8
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.brightness import Brightness, _median, falloff
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityCamera, DisparityStripes

CAMERA = DisparityCamera.of(RectifiedCamera(752, 480, 400.0, 400.0, 375.5, 239.5, 0.11, True, np.eye(4)))
H, W = CAMERA.height, CAMERA.width
FALLOFF = falloff(W, H, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
GAIN, POWER, DISPARITY = 0.12, 2.5, 24


def plain_pair(seed: int) -> tuple[U8, U8]:
    """A plain surface at one disparity, by a lens that darkens to the corners, with a left eye that is brighter."""
    rng = np.random.default_rng(seed)
    steps = np.cumsum(rng.normal(0.0, 1.5, (H, W + DISPARITY)), 1)
    surface = 150.0 + steps - cv2.blur(steps, (31, 1))
    darker = np.exp(-POWER * FALLOFF.astype(np.float64))
    left = surface[:, :W] * darker * np.exp(0.5 * GAIN)
    right = surface[:, DISPARITY:] * darker * np.exp(-0.5 * GAIN)
    images = [np.clip(image + rng.normal(0.0, 0.5, image.shape), 0.0, 255.0).round() for image in (left, right)]
    return images[0].astype(np.uint8), images[1].astype(np.uint8)


def right_share(disparity: F32) -> float:
    """Share of the pixels that both eyes saw which have their disparity."""
    inner = disparity[4:-4, DISPARITY + 8 : -4]
    return float((np.abs(inner - DISPARITY) < 0.5).mean())


def test_gain_and_falloff_are_learned_from_matches() -> None:
    found = Brightness()
    for seed in range(3):
        found = found.learned(plain_pair(seed), np.full((H, W), DISPARITY, np.float32), FALLOFF)
    assert found.gain == pytest.approx(GAIN, abs=0.005)
    assert found.power == pytest.approx(POWER, abs=0.1)


def test_wrong_matches_do_not_move_what_is_learned() -> None:
    rng, disparity = np.random.default_rng(5), np.full((H, W), DISPARITY, np.float32)
    wrong = rng.random((H, W)) < 0.2
    disparity[wrong] = rng.uniform(1.0, 47.0, int(wrong.sum()))
    found = Brightness().learned(plain_pair(0), disparity, FALLOFF)
    assert found.gain == pytest.approx(GAIN, abs=0.02)
    assert found.power == pytest.approx(POWER, abs=0.3)


def test_evened_images_have_one_brightness() -> None:
    left, right = Brightness(GAIN, POWER).evened(plain_pair(0), FALLOFF)
    apart = left[:, DISPARITY:].astype(np.float64) - right[:, :-DISPARITY]
    assert abs(float(apart.mean())) < 0.5
    assert np.abs(apart).mean() < 2.0


def test_too_few_matches_tell_nothing() -> None:
    known = Brightness(0.1, 2.0)
    assert known.learned(plain_pair(0), np.zeros((H, W), np.float32), FALLOFF) is known
    dark = np.full((H, W), 3, np.uint8)
    assert known.learned((dark, dark), np.full((H, W), 5, np.float32), FALLOFF) is known


def test_a_plain_surface_is_matched_where_it_is_once_brightness_is_known() -> None:
    stripes = DisparityStripes(CAMERA, GroundConfig())
    shares = []
    for seed in range(3):
        stripes.begin_reduced(plain_pair(seed))
        disparity = stripes.measure_begun()
        stripes.learn_brightness(disparity)
        shares.append(right_share(disparity))
    assert shares[0] < 0.9
    assert shares[2] > 0.97


def test_bright_corners_are_not_saturated() -> None:
    darker = np.exp(-POWER * FALLOFF)
    bright = np.round(245.0 * np.maximum(darker, 0.9) * np.linspace(0.9, 1.0, W)).astype(np.uint8)
    left, _ = Brightness(0.0, POWER).evened((bright, bright), FALLOFF)
    assert (left >= 255).mean() < 0.01


@pytest.mark.parametrize("n", [1, 2, 7, 200])
def test_median_is_that_of_numpy(n: int) -> None:
    values = np.random.default_rng(n).normal(0.0, 1.0, n)
    assert _median(values) == np.median(values)

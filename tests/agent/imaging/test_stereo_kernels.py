"""Stereo along the row: against a plain search, and against known sub-pixel disparities."""

import cv2
import numpy as np

from kiteline_agent.imaging import stereo_kernels
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_core.arrays import U8
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens, Rectifier
from kiteline_core.geometry.se3 import from_rt, so3_exp

RADIUS = stereo_kernels.RADIUS
LEVELS = 4  # as in flights: kernels are compiled for each number of levels


def pair(seed: int, disparity: float, rows: int = 200, columns: int = 320) -> tuple[U8, U8]:
    """Left and right image of a wall at one disparity, with a little noise."""
    rng = np.random.default_rng(seed)
    wide = cv2.GaussianBlur(rng.standard_normal((rows, columns + 80)), (0, 0), 1.5)
    wide = 120 + 35 * wide / wide.std()
    # Content at x of the left image lies at x - disparity of the right one; shifted exactly, in the Fourier domain.
    turn = np.exp(2j * np.pi * np.fft.fftfreq(columns + 80) * disparity)
    moved = np.real(np.fft.ifft(np.fft.fft(wide, axis=1) * turn, axis=1))
    crops = (image[:, 40 : 40 + columns] for image in (wide, moved))
    noisy = [np.clip(i + rng.normal(0, 1.0, i.shape) + 0.5, 0, 255).astype(np.uint8) for i in crops]
    return noisy[0], noisy[1]


UV = np.array([[float(x), float(y)] for y in range(30, 180, 20) for x in range(90, 300, 15)])
SURE = np.zeros(len(UV), np.bool_)
FLAT = np.zeros((len(UV), 2))


def test_search_then_refinement_recover_the_disparity() -> None:
    for disparity in (3.3, 17.62, 41.5):
        left, right = (build_pyramid(i, LEVELS) for i in pair(5, disparity))
        octave = (np.arange(len(UV)) % 2).astype(np.uint8)
        found_px, found = np.empty(len(UV)), np.zeros(len(UV), np.bool_)
        stereo_kernels.search_rows(left, right, UV, octave, 80.0, 1.15, found_px)
        assert (found_px >= 0).mean() > 0.9
        stereo_kernels.refine_rows(left, NO_GRID, right, NO_GRID, UV, octave, SURE, FLAT, 6, 3.0, 0.85, found_px, found)
        assert found.mean() > 0.85
        assert abs(np.median(found_px[found]) - disparity) < 0.04
        assert np.percentile(np.abs(found_px[found] - disparity), 90) < 0.15


def reference_search(left: U8, right: U8, x: int, y: int, reach: int) -> int:
    """Best integer disparity by zero-mean SAD, written plainly."""
    patch = left[y - RADIUS : y + RADIUS + 1, x - RADIUS : x + RADIUS + 1].astype(np.int64)
    costs = []
    for d in range(-1, min(reach, x - RADIUS) + 1):
        other = right[y - RADIUS : y + RADIUS + 1, x - d - RADIUS : x - d + RADIUS + 1].astype(np.int64)
        shift = patch.sum() // patch.size - other.sum() // other.size
        costs.append(np.abs(patch - other - shift).sum())
    return int(np.argmin(costs)) - 1


def test_search_is_the_plain_search() -> None:
    left, right = (build_pyramid(i, LEVELS) for i in pair(6, 21.0))
    out = np.empty(len(UV))
    stereo_kernels.search_rows(left, right, UV, np.zeros(len(UV), np.uint8), 80.0, 1.0, out)
    assert (out >= 0).mean() > 0.9
    for (u, v), d in zip(UV, out):
        if d >= 0:
            assert d == 2 * max(0, reference_search(left[1], right[1], int(u / 2 + 0.5), int(v / 2 + 0.5), 41))


def test_repetition_is_not_trusted() -> None:
    stripes = np.tile(((np.arange(320) // 8 % 2) * 120 + 60).astype(np.uint8), (200, 1))
    pyramid = build_pyramid(stripes, LEVELS)
    out = np.empty(len(UV))
    stereo_kernels.search_rows(pyramid, pyramid, UV, np.zeros(len(UV), np.uint8), 80.0, 1.15, out)
    assert (out < 0).all()


def test_unrelated_rows_are_not_refined() -> None:
    left, _ = pair(7, 10.0)
    _, right = pair(8, 10.0)
    guess, found = np.full(len(UV), 10.0), np.zeros(len(UV), np.bool_)
    stereo_kernels.refine_rows(
        build_pyramid(left, LEVELS), NO_GRID, build_pyramid(right, LEVELS), NO_GRID, UV,
        np.zeros(len(UV), np.uint8), SURE, FLAT, 6, 3.0, 0.85, guess, found,
    )  # fmt: skip
    assert found.mean() < 0.05


def test_strips_of_the_raw_image_say_what_the_rectified_one_says() -> None:
    model = CameraModel(320, 200, 220.0, 221.0, 158.0, 101.0, Lens.RADTAN, (-0.28, 0.07, 1e-4, 2e-5))
    rig = CameraRig(model, model, np.eye(4), from_rt(so3_exp(np.array([0.004, -0.006, 0.003])), np.array([0.1, 0, 0])))
    rectifier = Rectifier(rig)
    assert rectifier.right_grid is not None
    raw_left, raw_right = pair(9, 12.4)
    left = build_pyramid(rectifier.left(raw_left), LEVELS)
    octave = (np.arange(len(UV)) % 2).astype(np.uint8)
    results = []
    for right, grid in (
        (build_pyramid(rectifier.right(raw_right), LEVELS), NO_GRID),
        (build_pyramid(raw_right, LEVELS), rectifier.right_grid),
    ):
        guess, found = np.full(len(UV), 12.0), np.zeros(len(UV), np.bool_)
        stereo_kernels.refine_rows(left, NO_GRID, right, grid, UV, octave, SURE, FLAT, 6, 3.0, 0.8, guess, found)
        results.append((guess, found))
    (whole, whole_found), (strips, strips_found) = results
    both = whole_found & strips_found
    assert whole_found.sum() > 0.5 * len(UV) and both.sum() > 0.9 * whole_found.sum()
    assert np.median(np.abs(whole[both] - strips[both])) < 0.04
    assert np.percentile(np.abs(whole[both] - strips[both]), 90) < 0.12


def test_a_raw_left_image_says_what_the_rectified_one_says() -> None:
    model = CameraModel(320, 200, 220.0, 221.0, 158.0, 101.0, Lens.RADTAN, (-0.28, 0.07, 1e-4, 2e-5))
    rig = CameraRig(model, model, np.eye(4), from_rt(so3_exp(np.array([0.004, -0.006, 0.003])), np.array([0.1, 0, 0])))
    rectifier = Rectifier(rig)
    assert rectifier.left_grid is not None
    raw_left, raw_right = pair(9, 12.4)
    whole, right = (build_pyramid(i, LEVELS) for i in (rectifier.left(raw_left), rectifier.right(raw_right)))
    octave, results = np.zeros(len(UV), np.uint8), []
    for left, grid in ((whole, NO_GRID), (build_pyramid(raw_left, LEVELS), rectifier.left_grid)):
        guess, found = np.full(len(UV), 12.0), np.zeros(len(UV), np.bool_)
        stereo_kernels.refine_rows(left, grid, right, NO_GRID, UV, octave, SURE, FLAT, 6, 3.0, 0.8, guess, found)
        results.append((guess, found))
    both = results[0][1] & results[1][1]
    assert results[0][1].sum() > 0.5 * len(UV) and both.sum() > 0.95 * results[0][1].sum()
    assert np.percentile(np.abs(results[0][0][both] - results[1][0][both]), 90) < 0.03


def slanted_pair(slope_x: float, slope_y: float, disparity: float) -> tuple[U8, U8]:
    """Left and right image of a wall whose disparity changes by these slopes from the middle of the left image on."""
    right = pair(11, 0.0)[0]
    y, x = np.mgrid[: right.shape[0], : right.shape[1]].astype(np.float32)
    at = disparity + slope_x * (x - 0.5 * right.shape[1]) + slope_y * (y - 0.5 * right.shape[0])
    left = cv2.remap(right, x - at.astype(np.float32), y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return left, right


def test_slopes_of_the_disparity_take_the_error_of_slanted_surfaces_away() -> None:
    for slope_x, slope_y in ((0.08, 0.0), (0.0, 0.25), (-0.1, -0.15)):
        left, right = (build_pyramid(i, LEVELS) for i in slanted_pair(slope_x, slope_y, 30.0))
        true = 30.0 + (UV - [160.0, 100.0]) @ [slope_x, slope_y]
        octave, errors = np.zeros(len(UV), np.uint8), []
        for slopes in (FLAT, np.tile([slope_x, slope_y], (len(UV), 1))):
            guess, found = true.copy(), np.zeros(len(UV), np.bool_)
            stereo_kernels.refine_rows(
                left, NO_GRID, right, NO_GRID, UV, octave, SURE, slopes, 6, 3.0, 0.8, guess, found
            )
            errors.append(np.abs(guess - true)[found])
        assert len(errors[1]) > 0.85 * len(UV) and len(errors[1]) >= len(errors[0])
        assert np.percentile(errors[1], 75) < 0.5 * np.percentile(errors[0], 75)
        assert np.percentile(errors[1], 75) < 0.05


def test_a_raw_left_image_is_sampled_along_the_same_slopes() -> None:
    model = CameraModel(320, 200, 220.0, 221.0, 158.0, 101.0, Lens.RADTAN, (-0.28, 0.07, 1e-4, 2e-5))
    rig = CameraRig(model, model, np.eye(4), from_rt(np.eye(3), np.array([0.1, 0, 0])))
    rectifier = Rectifier(rig)
    assert rectifier.left_grid is not None
    raw_left, raw_right = slanted_pair(0.06, 0.2, 25.0)
    whole, right = (build_pyramid(i, LEVELS) for i in (rectifier.left(raw_left), rectifier.right(raw_right)))
    slopes, results = np.tile([0.06, 0.2], (len(UV), 1)), []
    for left, grid in ((whole, NO_GRID), (build_pyramid(raw_left, LEVELS), rectifier.left_grid)):
        guess, found = np.full(len(UV), 25.0), np.zeros(len(UV), np.bool_)
        near = np.abs(0.06 * (UV[:, 0] - 160.0) + 0.2 * (UV[:, 1] - 100.0)) < 5.0
        octave = np.zeros(len(UV), np.uint8)
        stereo_kernels.refine_rows(left, grid, right, NO_GRID, UV, octave, SURE, slopes, 6, 6.0, 0.7, guess, found)
        results.append((guess, found & near))
    both = results[0][1] & results[1][1]
    assert both.sum() > 20 and both.sum() > 0.9 * results[0][1].sum()
    assert np.percentile(np.abs(results[0][0][both] - results[1][0][both]), 90) < 0.04


def test_slanted_patches_that_reach_over_the_border_are_not_measured() -> None:
    model = CameraModel(320, 200, 220.0, 221.0, 158.0, 101.0, Lens.RADTAN, (-0.28, 0.07, 1e-4, 2e-5))
    rectifier = Rectifier(CameraRig(model, model, np.eye(4), from_rt(np.eye(3), np.array([0.1, 0, 0]))))
    image = build_pyramid(pair(12, 0.0)[0], LEVELS)
    uv = np.array([[x, 100.0] for x in (6.0, 8.0, 314.0, 312.0, 160.0)])
    steep, sure, octave = np.tile([0.5, 0.2], (5, 1)), np.ones(5, np.bool_), np.zeros(5, np.uint8)
    for grid in (NO_GRID, rectifier.left_grid):
        guess, found = np.full(5, 0.5), np.zeros(5, np.bool_)
        stereo_kernels.refine_rows(image, grid, image, NO_GRID, uv, octave, sure, steep, 6, 3.0, -1.0, guess, found)
        assert not found[:4].any()

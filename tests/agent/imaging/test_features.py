"""Corners and descriptors: spread, repeatable, and the same as written plainly."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging import corner_kernels, features
from kiteline_agent.imaging import feature_kernels as kernels
from kiteline_agent.imaging.features import DetectorConfig, build_pyramid, describe, detect
from kiteline_core import config as configuration
from kiteline_core.arrays import I32, I64, U8
from kiteline_core.config import ConfigError


def blobs(seed: int, turn_deg: float = 0.0) -> U8:
    """A grey image with many distinct patches of different shape, perhaps turned about its centre."""
    rng = np.random.default_rng(seed)
    image = np.full((400, 400), 120, np.uint8)
    for _ in range(260):
        x, y = rng.integers(10, 390, 2)
        w, h = rng.integers(4, 26, 2)
        box = cv2.boxPoints(((float(x), float(y)), (float(w), float(h)), float(rng.uniform(0, 90))))
        cv2.fillConvexPoly(image, box.astype(np.int32), int(rng.integers(20, 235)), cv2.LINE_AA)
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    if turn_deg:
        image = cv2.warpAffine(image, cv2.getRotationMatrix2D((199.5, 199.5), turn_deg, 1.0), (400, 400))
    return np.asarray(image, np.uint8)


def hamming(a: U8, b: U8) -> I64:
    return np.unpackbits(a[:, None] ^ b[None, :], axis=2).sum(axis=2).astype(np.int64)


def test_one_corner_a_free_cell_strongest_first() -> None:
    config = DetectorConfig()
    pyramid = build_pyramid(blobs(1), 4)
    corners = detect(pyramid, np.zeros((0, 2)), config)
    cells = (corners.uv // config.cell_px).astype(int)
    assert len(np.unique(cells, axis=0)) == len(cells) > 40
    assert (np.diff(corners.score) <= 0).all()
    taken = corners.uv[:20]
    again = detect(pyramid, taken, config)
    free = {tuple(c) for c in (taken // config.cell_px).astype(int)}
    assert not free & {tuple(c) for c in (again.uv // config.cell_px).astype(int)}


def test_a_noisier_camera_has_stronger_corners_by_stricter_thresholds() -> None:
    pyramid, config = build_pyramid(blobs(1), 4), replace(DetectorConfig(), faint_below=1)
    usual = detect(pyramid, np.zeros((0, 2)), config)
    assert len(detect(pyramid, np.zeros((0, 2)), replace(config, fast_threshold=80)).uv) < 0.9 * len(usual.uv)
    least = float(np.median(usual.score))
    assert detect(pyramid, np.zeros((0, 2)), replace(config, min_score=least)).score.min() >= least


def test_covered_parts_have_no_corners_and_the_rest_has_the_same() -> None:
    pyramid, config = build_pyramid(blobs(1), 4), DetectorConfig()
    h, w = pyramid[0].shape
    covered = replace(config, covered=(0.0, 0.5, 0.25, 1.0, 0.9, 0.0, 1.0, 0.1))
    every, left = (detect(pyramid, np.zeros((0, 2)), c).uv for c in (config, covered))
    inside = ((left[:, 0] < 0.25 * w) & (left[:, 1] >= 0.5 * h)) | ((left[:, 0] >= 0.9 * w) & (left[:, 1] < 0.1 * h))
    assert not inside.any()
    cells = (every // config.cell_px).astype(int) * config.cell_px  # a cell is covered if a part of it is
    free = ((cells[:, 0] >= 0.25 * w) | (cells[:, 1] + config.cell_px <= 0.5 * h)) & (
        (cells[:, 0] + config.cell_px <= 0.9 * w) | (cells[:, 1] >= 0.1 * h)
    )
    assert 40 < free.sum() < len(every)
    assert {tuple(uv) for uv in every[free]} == {tuple(uv) for uv in left}


@pytest.mark.parametrize("covered", ["[0, 0.5, 0.25]", "[0, 0.5, 0.25, 1.5]", "[0.3, 0, 0.2, 1]", "[0, 0.5, 1, 0.5]"])
def test_what_is_no_part_of_an_image_is_refused(covered: str) -> None:
    with pytest.raises(ConfigError, match="covered: "):
        configuration.load(AgentConfig(), f"[agent.detector]\ncovered = {covered}", "agent", "file")


def test_flat_image_has_no_corner() -> None:
    assert len(detect(build_pyramid(np.full((200, 300), 77, np.uint8), 4), np.zeros((0, 2)), DetectorConfig()).uv) == 0


def test_scores_are_the_smaller_eigenvalue() -> None:
    image = blobs(2)
    rng = np.random.default_rng(0)
    xy = rng.integers(8, 390, (50, 2)).astype(np.int32)
    out = np.empty(50)
    kernels.corner_scores(image, xy, out)
    f = image.astype(np.float64)
    dx, dy = np.zeros_like(f), np.zeros_like(f)
    dx[:, 1:-1] = 0.5 * (f[:, 2:] - f[:, :-2])
    dy[1:-1] = 0.5 * (f[2:] - f[:-2])
    for (x, y), score in zip(xy, out):
        gx, gy = dx[y - 3 : y + 4, x - 3 : x + 4].ravel(), dy[y - 3 : y + 4, x - 3 : x + 4].ravel()
        tensor = np.array([[gx @ gx, gx @ gy], [gx @ gy, gy @ gy]]) / 49.0
        np.testing.assert_allclose(score, np.linalg.eigvalsh(tensor)[0], atol=1e-9)


def test_descriptors_survive_a_turn_and_tell_corners_apart() -> None:
    first, turned = blobs(3), blobs(3, 40.0)
    pyramid, other = build_pyramid(first, 3), build_pyramid(turned, 3)
    corners = detect(pyramid, np.zeros((0, 2)), DetectorConfig())
    matrix = cv2.getRotationMatrix2D((199.5, 199.5), 40.0, 1.0)
    moved = np.round(corners.uv @ matrix[:, :2].T + matrix[:, 2])
    keep = ((moved > 80) & (moved < 320)).all(axis=1) & (corners.octave == 0)
    _, a = describe(pyramid, corners.uv[keep], corners.octave[keep])
    angle, b = describe(other, moved[keep], corners.octave[keep])
    d = hamming(a, b)
    right = np.diag(d)
    wrong = d[~np.eye(len(d), dtype=bool)]
    assert len(right) > 4
    assert right.max() < 35 < np.percentile(wrong, 2)
    assert angle.dtype == np.uint8


def test_describe_is_the_plain_description() -> None:
    image = blobs(4)
    xy = np.array([[18, 70], [200, 210], [381, 381]], np.int32)  # as near to the border as may be
    angle = np.array([0.0, 1.1, -2.0])
    out = np.empty((3, 32), np.uint8)
    tests = np.empty((3, 2, 256), np.int16)
    kernels.steer(features.PATTERN, angle, tests)
    kernels.describe(image, xy, np.arange(3), tests, out)
    smooth = cv2.GaussianBlur(image, (7, 7), 2.0)
    for k in range(3):
        c, s = np.cos(angle[k]), np.sin(angle[k])
        turn = np.array([[c, -s], [s, c]])
        a = np.floor(features.PATTERN[:, :2] @ turn.T + 0.5).astype(int) + xy[k]
        b = np.floor(features.PATTERN[:, 2:] @ turn.T + 0.5).astype(int) + xy[k]
        bits = smooth[a[:, 1], a[:, 0]] < smooth[b[:, 1], b[:, 0]]
        np.testing.assert_array_equal(out[k], np.packbits(bits, bitorder="little"))


def test_pattern_stays_as_it_was_frozen() -> None:
    assert features.PATTERN.shape == (256, 4)
    assert np.abs(features.PATTERN).max() <= features.PATTERN_REACH_PX
    weights = np.arange(1, 1025).reshape(256, 4)
    assert (
        int((features.PATTERN * weights).sum()) == 70162
    )  # two builds that differ here cannot match each other's corners


@pytest.mark.parametrize("sigma", [0.5, 1.2, 2.0, 3.0])
def test_noise_has_no_corners_and_is_measured(sigma: float) -> None:
    rng = np.random.default_rng(4)
    noise = np.clip(np.round(120.0 + sigma * rng.standard_normal((480, 752))), 0, 255).astype(np.uint8)
    assert len(features.detect(features.build_pyramid(noise, 4), np.zeros((0, 2)), DetectorConfig()).uv) == 0
    assert features.noise_of(noise) == pytest.approx(sigma, abs=0.2)


@pytest.mark.parametrize("sigma", [0.5, 1.2])
def test_faint_corners_are_found_where_there_are_few_others(sigma: float) -> None:
    rng = np.random.default_rng(5)
    patches = np.kron(rng.uniform(98.0, 114.0, (30, 47)), np.ones((16, 16)))
    image = np.clip(np.round(patches + sigma * rng.standard_normal(patches.shape)), 0, 255).astype(np.uint8)
    pyramid, nothing = features.build_pyramid(image, 4), np.zeros((0, 2))
    assert len(features.detect(pyramid, nothing, DetectorConfig(faint_below=0)).uv) < 30
    found = features.detect(pyramid, nothing, DetectorConfig())
    assert len(found.uv) > 80
    corner = np.abs((found.uv + 0.5 + 8.0) % 16.0 - 8.0).max(axis=1)
    assert np.mean(corner < 4.0) > 0.8, "corners of the patches, not of the noise, of which a quarter would be so near"


def noise(seed: int, rows: int, columns: int) -> U8:
    """Grey noise, smoothed so far that it has corners of all strengths."""
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.standard_normal((rows, columns)), (0, 0), 1.3)
    return np.asarray(np.clip(128 + 50 * image / image.std(), 0, 255), np.uint8)


def by_opencv(image: U8, threshold: int, margin: int) -> I32:
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

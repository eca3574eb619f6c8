"""Ground segmentation of ideal and spoilt disparity images: level and banked cameras, ramps, walls, plain floors."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan, level_rotation
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityCamera, DisparityStripes, unlocked
from kiteline_core.ground.label_kernels import GROUND, OBSTACLE, UNKNOWN
from kiteline_core.ground.segmentation import ExpectedGround, GroundSegmenter, _near_height

CAMERA = RectifiedCamera(752, 480, 430.0, 430.0, 375.0, 245.0, 0.11, True, np.eye(4))
HEIGHT_M = 1.5
Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]


def level_ground(_o: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Range factor of rays r (…,3) in l to the ground, inf without."""
    return np.where(r[..., 2] < -1e-6, -HEIGHT_M / np.minimum(r[..., 2], -1e-6), np.inf)


def ramp(_o: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Level up to 3 m ahead, then 12 percent up."""
    level = level_ground(_o, r)
    up = 0.12 * r[..., 0] - r[..., 2]
    on_ramp = np.where(up > 1e-6, (HEIGHT_M + 0.36) / np.maximum(up, 1e-6), np.inf)
    return np.where(level * r[..., 0] < 3.0, level, on_ramp)


def wall(
    ahead_m: float, low_m: float = -10.0, high_m: float = 10.0, left_m: float = 99.0, right_m: float = 99.0
) -> Surface:
    """A wall across, between heights above the camera and to the sides."""

    def hit(_o: np.ndarray, r: np.ndarray) -> np.ndarray:
        t = np.where(r[..., 0] > 1e-6, ahead_m / np.maximum(r[..., 0], 1e-6), np.inf)
        y, z = t * r[..., 1], t * r[..., 2]
        return np.where((z > low_m) & (z < high_m) & (y < left_m) & (y > -right_m), t, np.inf)

    return hit


def view(
    up_c: np.ndarray, *surfaces: Surface, noise_px: float = 0.15, seed: int = 0
) -> tuple[GroundSegmenter, np.ndarray]:
    """A segmenter and the disparity image of surfaces as a camera sees them."""
    segmenter = GroundSegmenter(CAMERA, GroundConfig())
    c = segmenter.camera
    u, v = np.meshgrid((np.arange(c.width) - c.cx) / c.fx, (np.arange(c.height) - c.cy) / c.fy)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ level_rotation(up_c)
    depth = np.min([surface(np.zeros(3), rays) for surface in surfaces], axis=0)
    d = c.bf / depth
    d = d + np.random.default_rng(seed).normal(0.0, noise_px, d.shape)
    return segmenter, np.where((d > 0.3) & (d < 48.0), d, 0.0).astype(np.float32)


def up(roll_deg: float = 0.0, pitch_deg: float = 8.0) -> np.ndarray:
    """Up in the camera that looks down by a pitch, and rolls."""
    R = se3.so3_exp(np.array([0.0, 0.0, np.radians(roll_deg)])) @ se3.so3_exp(
        np.array([np.radians(pitch_deg), 0.0, 0.0])
    )
    return np.asarray(R @ np.array([0.0, -1.0, 0.0]))


def assert_free_up_to(scan: ColumnScan, ahead_m: float, share: float = 0.95) -> None:
    """Ground before a wall across is free, and nothing behind it; the wall is seen in most columns."""
    true_m = ahead_m / np.cos(scan.azimuths_rad)
    assert (scan.free_m <= true_m + 0.15).all()
    assert (scan.free_m[scan.free_from_m > 0] > true_m[scan.free_from_m > 0] - 0.5).mean() > share
    assert (np.abs(scan.obstacle_m - true_m) < 0.1).mean() > share


@pytest.mark.parametrize("roll_deg", [0.0, 25.0, -40.0, 180.0])
def test_a_banked_camera_sees_the_same_ground(roll_deg: float) -> None:
    segmenter, disparity = view(up(roll_deg), level_ground, wall(4.0))
    scan = segmenter.segment(disparity, None, up(roll_deg)).scan
    assert scan.camera_height_m == pytest.approx(HEIGHT_M, abs=0.04)
    assert (scan.free_m > 0).mean() > 0.6
    assert_free_up_to(scan, 4.0, 0.6 if roll_deg else 0.95)
    if roll_deg in (0.0, 180.0):
        inside = np.abs(scan.azimuths_rad) < 0.7  # beyond, the lower corners of the image show ground alone
        assert (np.isfinite(scan.obstacle_m[inside])).all()
        assert not np.isfinite(scan.obstacle_m[[0, -1]]).any() and (scan.free_m[[0, -1]] > 0).all()
        assert (scan.bands[20:50] & 3 == 3).all()  # the wall stands on the ground


def test_a_ramp_is_ground() -> None:
    segmenter, disparity = view(up(), ramp)
    scan = segmenter.segment(disparity, None, up()).scan
    labels = segmenter.labels[disparity > 3.0]
    assert (labels == GROUND).mean() > 0.9
    assert (labels == OBSTACLE).mean() < 0.05
    assert (scan.obstacle_m > 9.5).all()  # where a disparity of 2.5 px is off by a tenth
    assert (scan.free_m > 5.0).mean() > 0.9


@pytest.mark.parametrize("roll_deg", [0.0, 180.0])
def test_nothing_is_free_in_columns_of_which_much_is_unknown(roll_deg: float) -> None:
    """Between the known pixels of a column something may stand."""
    segmenter, disparity = view(up(roll_deg), level_ground, wall(4.0))
    whole = segmenter.segment(disparity, None, up(roll_deg)).scan
    h, w = disparity.shape
    below = slice(h // 2, h) if roll_deg == 0.0 else slice(0, h // 2)
    for rows, free in ((8, True), (2, False)):  # a row of so many is unknown
        spoilt = disparity.copy()
        spoilt[below][::rows, w // 3 : w // 2] = 0.0
        found = segmenter.segment(spoilt, None, up(roll_deg)).scan
        middle = (w // 3 + 6 - segmenter.camera.cx, w // 2 - 6 - segmenter.camera.cx)
        azimuth = np.sort(np.arctan(np.array(middle) / segmenter.camera.fx) * (-1.0 if roll_deg == 0.0 else 1.0))
        inside = (found.azimuths_rad > azimuth[0]) & (found.azimuths_rad < azimuth[1])
        assert inside.sum() > 5 and ((found.free_m[inside] > 0.0) == free).all()
        assert np.isfinite(found.obstacle_m[inside]).all()
        beside = np.abs(found.azimuths_rad - azimuth.mean()) > 0.5 * np.ptp(azimuth) + 0.15
        assert np.array_equal(found.free_m[beside] > 0.0, whole.free_m[beside] > 0.0)


def test_a_wave_is_ground() -> None:
    def wave(_o: np.ndarray, r: np.ndarray) -> np.ndarray:
        t = level_ground(_o, r)
        for _ in range(30):
            t = np.where(
                np.isfinite(t),
                (HEIGHT_M - 0.12 * np.sin(np.minimum(t, 50.0) * r[..., 0])) / -np.minimum(r[..., 2], -1e-6),
                t,
            )
        return t

    segmenter, disparity = view(up(), wave)
    segmenter.segment(disparity, None, up())
    assert (segmenter.labels[disparity > 4.0] == GROUND).mean() > 0.8


def test_a_box_on_the_ground_is_an_obstacle_of_its_height() -> None:
    box = wall(3.0, -HEIGHT_M, -HEIGHT_M + 0.4, 0.3, 0.3)
    segmenter, disparity = view(up(), level_ground, wall(6.0), box)
    scan = segmenter.segment(disparity, None, up()).scan
    inside = np.abs(np.tan(scan.azimuths_rad) * 3.0) < 0.22
    assert np.abs(scan.obstacle_m[inside] * np.cos(scan.azimuths_rad[inside]) - 3.0).max() < 0.12
    assert (scan.bands[inside] == 1).all()
    beside = np.abs(np.tan(scan.azimuths_rad) * 3.0) > 0.4
    assert (scan.obstacle_m[beside] > 5.0).all()
    at_box = np.flatnonzero(scan.obstacle_m < 4.0)
    for i in (at_box[0] - 1, at_box[-1] + 1):  # they may show some of it
        assert scan.free_m[i] < 3.2
    seen = np.isfinite(scan.obstacle_m)  # the lower corners show no wall
    assert (scan.free_m[: at_box[0] - 1][seen[: at_box[0] - 1]] > 4.5).all()
    assert (scan.free_m[at_box[-1] + 2 :][seen[at_box[-1] + 2 :]] > 4.5).all()


def test_ground_behind_a_low_obstacle_is_free() -> None:
    """A box so near that no ground is seen before it."""
    box = wall(1.2, -HEIGHT_M, -HEIGHT_M + 0.6)
    segmenter, disparity = view(up(0.0, 25.0), level_ground, wall(5.0), box)
    scan = segmenter.segment(disparity, None, up(0.0, 25.0)).scan
    ahead = np.cos(scan.azimuths_rad)
    middle = slice(12, -12)
    assert np.abs((scan.obstacle_m * ahead)[middle] - 1.2).max() < 0.1
    assert ((scan.free_from_m * ahead)[middle] > 1.2 * HEIGHT_M / 0.9 - 0.15).all()  # what the box hides is unknown
    assert ((scan.free_m * ahead)[middle] > 4.0).mean() > 0.9 and (scan.free_m * ahead < 5.0).all()


def test_ground_that_is_seen_beside_a_leg_is_not_seen_over_it() -> None:
    leg = wall(2.0, -HEIGHT_M, -HEIGHT_M + 0.75, 0.025, 0.025)
    segmenter, disparity = view(up(), level_ground, wall(5.0), leg)
    scan = segmenter.segment(disparity, None, up()).scan
    at_leg = np.isfinite(scan.obstacle_m) & (scan.obstacle_m < 2.5)
    assert at_leg.any()
    before, over = scan.free_m[at_leg] < 2.2, scan.free_from_m[at_leg] > 2.9  # 0.5 m high is the band of its upper end
    assert (before | over).all()


def test_a_plain_floor_is_unknown() -> None:
    segmenter, disparity = view(up(), level_ground, wall(4.0))
    image = np.random.default_rng(1).normal(120.0, 0.45, segmenter.labels.shape).round().astype(np.uint8)
    image[: len(image) // 2] = np.random.default_rng(2).integers(0, 255, image[: len(image) // 2].shape)
    scan = segmenter.segment(disparity, (image, image), up()).scan
    floor = segmenter.labels[len(image) // 2 + 5 :]
    assert (floor == GROUND).mean() < 1e-2
    assert (scan.free_m == 0.0).mean() > 0.95


def test_a_camera_that_faces_a_wall_says_unknown() -> None:
    segmenter, disparity = view(up(0.0, 0.0), level_ground, wall(0.9))
    scan = segmenter.segment(disparity, None, up(0.0, 0.0)).scan
    assert np.isnan(scan.camera_height_m)
    assert not scan.free_m.any()
    assert np.abs(scan.clear_m * np.cos(scan.azimuths_rad) - 0.9).max() < 0.1
    expected = segmenter.segment(disparity, None, up(0.0, 0.0), expected=ExpectedGround(HEIGHT_M, 0.1)).scan
    assert np.abs(expected.obstacle_m * np.cos(scan.azimuths_rad) - 0.9).max() < 0.1
    assert not expected.free_m.any()


def test_a_table_is_not_taken_for_the_ground_that_was_expected() -> None:
    segmenter, disparity = view(up(0.0, 20.0), lambda o, r: 0.5 * level_ground(o, r), wall(3.0))
    alone = segmenter.segment(disparity, None, up(0.0, 20.0)).scan
    assert alone.camera_height_m == pytest.approx(0.5 * HEIGHT_M, abs=0.05)
    scan, saw_ground, _ = segmenter.segment(disparity, None, up(0.0, 20.0), expected=ExpectedGround(HEIGHT_M, 0.1))
    assert scan.camera_height_m == HEIGHT_M and not saw_ground
    assert not scan.free_m.any()
    assert np.isfinite(scan.obstacle_m).mean() > 0.9


def test_a_low_platform_far_away_is_not_ground_however_uncertain_its_height() -> None:
    def platform(_o: np.ndarray, r: np.ndarray) -> np.ndarray:
        top = (HEIGHT_M - 0.18) / np.maximum(-r[..., 2], 1e-6)
        return np.where((top * r[..., 0] > 4.5) & (np.abs(top * r[..., 1]) < 0.7) & (r[..., 2] < 0.0), top, np.inf)

    edge = wall(4.5, -HEIGHT_M, -HEIGHT_M + 0.18, 0.7, 0.7)
    segmenter, disparity = view(up(), level_ground, platform, edge, noise_px=0.02)
    scan = segmenter.segment(disparity, None, up(), expected=ExpectedGround(HEIGHT_M, 0.1)).scan
    there = np.abs(np.tan(scan.azimuths_rad)) < 0.1
    assert (scan.free_m[there] > 4.0).mean() > 0.9
    assert (scan.free_m[there] < 5.2).all()


@pytest.mark.parametrize("seed", range(3))
def test_half_of_the_disparities_may_be_missing_or_wrong(seed: int) -> None:
    rng = np.random.default_rng(seed)
    segmenter, disparity = view(up(), level_ground, wall(4.0), seed=seed)
    blocks = rng.random((15, 24)) < 0.5
    missing = np.kron(blocks, np.ones((8, 16), bool))[: disparity.shape[0], : disparity.shape[1]]
    scan = segmenter.segment(np.where(missing, 0.0, disparity).astype(np.float32), None, up()).scan
    assert (scan.free_m <= 4.0 / np.cos(scan.azimuths_rad) + 0.2).all()
    noise = rng.uniform(0.0, 48.0, disparity.shape).astype(np.float32)
    scan = segmenter.segment(noise, None, up()).scan
    assert not (scan.free_m > 0).any()


@pytest.mark.parametrize("direction", [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
def test_any_attitude_gives_a_scan(direction: list[float]) -> None:
    segmenter, disparity = view(up(), level_ground, wall(4.0))
    scan = segmenter.segment(disparity, None, np.array(direction)).scan
    assert (scan.free_m <= 60.0).all()
    assert np.array_equal(np.isfinite(scan.obstacle_m), scan.bands > 0)
    nothing = segmenter.segment(np.zeros_like(disparity), None, np.array(direction)).scan
    assert not nothing.free_m.any() and not nothing.clear_m.any() and np.isinf(nothing.obstacle_m).all()
    assert (segmenter.labels == UNKNOWN).all()


def test_level_rotation_is_a_rotation_with_z_up() -> None:
    rng = np.random.default_rng(3)
    for up_c in [*rng.normal(size=(20, 3)), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])]:
        R = level_rotation(up_c)
        assert np.allclose(R.T @ R, np.eye(3)) and np.linalg.det(R) > 0.0
        assert np.allclose(R[:, 2], up_c / np.linalg.norm(up_c))
        assert (R.T @ [0.0, 0.0, 1.0])[0] > -1e-12  # the camera looks ahead
        assert abs((R.T @ [0.0, 0.0, 1.0])[1]) < 1e-12


def test_stripes_measure_a_shifted_image_to_a_fraction_of_a_pixel() -> None:
    rng = np.random.default_rng(4)
    wide = np.kron(rng.integers(0, 255, (240, 500)), np.ones((1, 8))).astype(np.float64)
    wide = (wide + np.roll(wide, 3, 1) + np.roll(wide, 5, 1)) / 3.0
    segmenter = GroundSegmenter(CAMERA, GroundConfig())
    stripes = DisparityStripes(segmenter.camera, GroundConfig())
    for d in (4.0, 6.25, 9.375, 12.5):
        left, right = (
            wide[:, s : s + 8 * 376].reshape(240, 376, 8).mean(2).round().astype(np.uint8)
            for s in (400, 400 + round(8 * d))
        )
        found = stripes.measure(left, right)
        assert found.shape == segmenter.labels.shape
        inner = found[5:-5, 60:-20]
        assert (inner > 0).mean() > 0.9
        assert abs(float(np.median(inner[inner > 0])) - d) < 0.13


def test_unlocked_disparities_are_ordered_and_keep_whole_and_half_pixels() -> None:
    raw = np.arange(-16, 800, dtype=np.int16)[None]
    d = unlocked(raw)[0]
    assert (d[:17] == 0.0).all()
    assert (np.diff(d[17:]) > 0.0).all()
    whole = raw[0] > 0
    assert np.allclose(d[whole & (raw[0] % 8 == 0)], raw[0][whole & (raw[0] % 8 == 0)] / 16.0)


def test_surfaces_are_refined_by_their_images() -> None:
    """A wall whose disparities are all off by a fifth of a pixel is found where the images show it."""
    segmenter, disparity = view(up(0.0, 0.0), level_ground, wall(3.0), noise_px=0.0)
    rng, (h, w) = np.random.default_rng(6), disparity.shape
    texture = rng.normal(120.0, 40.0, (h, w + 80))
    for _ in range(4):
        texture = (np.roll(texture, 1, 1) + 2.0 * texture + np.roll(texture, -1, 1)) / 4.0
    true_px = segmenter.camera.bf / 3.0
    at = np.arange(w) + 40.0
    left = texture[:, 40 : 40 + w]
    right = np.array([np.interp(at + true_px, np.arange(w + 80), row) for row in texture]) * 1.03 + 4.0
    pair = left.round().clip(0, 255).astype(np.uint8), right.round().clip(0, 255).astype(np.uint8)
    wrong = np.where(disparity > 0.0, disparity + 0.2, 0.0).astype(np.float32)
    plain = segmenter.segment(wrong, None, up(0.0, 0.0), expected=ExpectedGround(HEIGHT_M, 0.1)).scan
    refined = segmenter.segment(wrong, pair, up(0.0, 0.0), expected=ExpectedGround(HEIGHT_M, 0.1)).scan
    seen = slice(8, -8)
    errors = [np.median(np.abs((s.obstacle_m * np.cos(s.azimuths_rad))[seen] - 3.0)) for s in (plain, refined)]
    assert errors[0] > 0.05
    assert errors[1] < 0.015


def test_what_hangs_into_the_highest_band_is_no_outlier_of_the_wall_behind() -> None:
    """A few of its pixels count; those above the bands tell that it is a surface."""
    hanging = wall(4.3, low_m=1.88 - HEIGHT_M, left_m=0.8, right_m=0.8)
    segmenter, disparity = view(up(0.0, -5.0), level_ground, wall(5.3), hanging, noise_px=0.05)
    expected = ExpectedGround(HEIGHT_M, 0.1)
    scan = segmenter.segment(disparity, None, up(0.0, -5.0), expected=expected).scan
    before = np.abs(scan.azimuths_rad) < 0.13
    assert (np.abs(scan.obstacle_m[before] * np.cos(scan.azimuths_rad[before]) - 4.3) < 0.15).all()
    assert (scan.bands[before] == 4).all()
    beside = np.abs(np.abs(scan.azimuths_rad) - 0.35) < 0.08
    assert (np.abs(scan.obstacle_m[beside] * np.cos(scan.azimuths_rad[beside]) - 5.3) < 0.15).all()


def test_labels_outside_of_the_image_are_unknown() -> None:
    segmenter, disparity = view(up(0.0, 0.0), level_ground)
    segmenter.segment(disparity, None, up(0.0, 0.0), expected=ExpectedGround(HEIGHT_M, 0.1))
    uv = np.array([[375.0, 460.0], [375.0, 480.5], [-3.0, 460.0], [760.0, 460.0], [375.0, -20.0]])
    assert segmenter.label_of(uv).tolist() == [GROUND, UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN]


def test_the_height_of_ground_hangs_on_many_of_its_pixels() -> None:
    """A few pixels at the near end that lie higher do not lift it."""
    d = np.array([12.0, 8.0, 7.0, 6.0, 5.0, 4.0])
    n = np.array([5.0, 100.0, 120.0, 150.0, 150.0, 150.0])
    heights = np.array([0.8, 1.5, 1.5, 1.5, 1.5, 1.5])
    assert _near_height(n, d, heights * d) == pytest.approx(1.5)


def test_ground_is_looked_for_as_far_below_the_camera_as_is_asked() -> None:
    def floor(_o: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.where(r[..., 2] < -1e-6, -5.0 / np.minimum(r[..., 2], -1e-6), np.inf)

    heights = []
    for largest_height_m in (8.0, 3.0):
        segmenter = GroundSegmenter(CAMERA, GroundConfig(largest_height_m=largest_height_m))
        _, disparity = view(up(pitch_deg=35.0), floor)
        heights.append(segmenter.segment(disparity, None, up(pitch_deg=35.0)).scan.camera_height_m)
    assert heights[0] == pytest.approx(5.0, abs=0.2) and np.isnan(heights[1])


def test_depth_cameras_have_an_error_of_their_own() -> None:
    camera = replace(CAMERA, stereo=False)
    sigma_px = [GroundSegmenter(camera, GroundConfig(depth_sigma=s)).sigma_px for s in (0.003, 0.006)]
    assert sigma_px[1] == pytest.approx(2.0 * sigma_px[0])
    assert GroundSegmenter(CAMERA, GroundConfig(depth_sigma=0.006)).sigma_px == GroundConfig().sigma_px


@pytest.mark.parametrize(("disparities", "found"), [(32, False), (48, True)])
def test_surfaces_are_measured_as_near_as_disparities_are_searched(disparities: int, found: bool) -> None:
    rng = np.random.default_rng(3)
    texture = np.repeat(rng.integers(0, 255, (480, 376)), 2, axis=1).astype(np.uint8)
    camera = DisparityCamera.of(CAMERA)
    stripes = DisparityStripes(camera, GroundConfig(disparities=disparities))
    half = texture[::2, ::2][:240, :376]
    disparity = stripes.measure(half, np.roll(half, -40, axis=1))
    near = disparity[:, 60:-60]
    assert (np.mean(np.abs(near - 40.0) < 0.5) > 0.5) == found

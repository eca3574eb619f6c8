"""Rows of the right image: offsets are measured in two dimensions, and a worn right camera is read where it looks."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from kiteline_agent.imaging import row_kernels
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.imaging.raw_grid import grid_for_kernels
from kiteline_agent.imaging.row_alignment import RowAlignment, RowConfig, terms
from kiteline_core.arrays import F64, U8, Bool
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens, Rectifier

LEVELS = 4  # as in flights: kernels are compiled for each number of levels
WIDTH, HEIGHT, FOCAL, DEPTH_M = 640, 400, 420.0, 3.0
T_C_R = se3.from_rt(np.eye(3), np.array([0.11, 0.0, 0.0]))
TURNED = np.array([2.5e-3, -1e-3, 1.5e-3])  # rad: pitch, yaw and roll of the right camera
UV = np.array([[float(x), float(y)] for y in range(40, 370, 18) for x in range(90, 600, 22)])


def wall(x_m: F64, y_m: F64) -> U8:
    """Texture of a wall at points in m, with edges in all directions; without repetition."""
    rng = np.random.default_rng(3)
    waves = rng.normal(0.0, 14.0, (60, 2))
    phase = rng.uniform(0.0, 2 * np.pi, 60)
    value = sum(np.sin(a * x_m + b * y_m + p) for (a, b), p in zip(waves, phase, strict=True))
    return np.clip(128 + 12 * np.asarray(value), 0, 255).astype(np.uint8)


def image(camera: CameraModel, T_c_w: F64) -> U8:
    """A camera's image of the wall, which lies in z = DEPTH_M of w."""
    u, v = np.meshgrid(np.arange(WIDTH, dtype=np.float64), np.arange(HEIGHT, dtype=np.float64))
    pixels = np.stack([u.ravel(), v.ravel()], 1)[:, None]
    xy = cv2.undistortPoints(pixels, camera.matrix(), np.array(camera.distortion or (0.0,) * 4))[:, 0]
    T_w_c = se3.inverse(T_c_w)
    rays = np.column_stack([xy, np.ones(len(xy))]) @ T_w_c[:3, :3].T
    at = T_w_c[:3, 3] + rays * ((DEPTH_M - T_w_c[2, 3]) / rays[:, 2])[:, None]
    return wall(at[:, 0], at[:, 1]).reshape(HEIGHT, WIDTH)


def told_camera(lens: Lens) -> CameraModel:
    distortion = () if lens is Lens.NONE else (-0.25, 0.06, 0.0, 0.0)
    return CameraModel(WIDTH, HEIGHT, FOCAL, FOCAL, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1), lens, distortion)


@cache
def eye(lens: Lens, right: bool, turned: tuple[float, ...]) -> U8:
    """The left image, or that of a right camera which is turned; drawn once."""
    true = T_C_R @ se3.from_rt(se3.so3_exp(np.array(turned)), np.zeros(3))
    return image(told_camera(lens), se3.inverse(true) if right else np.eye(4))


def flight(lens: Lens, turned: F64) -> tuple[Rectifier, U8, U8]:
    """The rectifier of a told calibration, and a pair by a rig whose right camera is turned against it."""
    rig = CameraRig(told_camera(lens), told_camera(lens), np.eye(4), T_C_R)
    return Rectifier(rig), eye(lens, False, (0.0, 0.0, 0.0)), eye(lens, True, tuple(turned.tolist()))


def measured(rectifier: Rectifier, left: U8, right: U8) -> tuple[F64, Bool]:
    """Row offsets of UV."""
    eyes = [build_pyramid(eye, LEVELS) for eye in (rectifier.left(left), right)]
    grid = grid_for_kernels(rectifier.right_grid)
    disparity = np.full(len(UV), rectifier.camera.bf / DEPTH_M)
    offset, found = np.zeros(len(UV)), np.zeros(len(UV), np.bool_)
    octave = np.zeros(len(UV), np.uint8)
    row_kernels.measure_rows(eyes[0], eyes[1], grid, UV, octave, disparity, 10, 3.5, 0.9, offset, found)
    return offset, found


def expected(rectifier: Rectifier, uv: F64, turned: F64) -> F64:
    """Rows in the image of a turned right camera less those of a true one."""
    camera = rectifier.camera
    right = uv - [camera.bf / DEPTH_M, 0.0]
    rays = np.column_stack([(right - [camera.cx, camera.cy]) / camera.fx, np.ones(len(uv))]) @ se3.so3_exp(turned)
    return np.asarray(rays[:, 1] / rays[:, 2] * camera.fy + camera.cy - right[:, 1])


@pytest.mark.parametrize("lens", [Lens.NONE, Lens.RADTAN])
def test_offsets_of_rows_are_measured(lens: Lens) -> None:
    rectifier, left, right = flight(lens, TURNED)
    offset, found = measured(rectifier, left, right)
    assert found.mean() > 0.7
    error = offset - expected(rectifier, UV, TURNED)
    assert abs(np.median(error[found])) < 0.05
    assert np.percentile(np.abs(error[found]), 90) < 0.2


@pytest.mark.parametrize("lens", [Lens.NONE, Lens.RADTAN])
def test_a_turned_right_camera_is_read_at_its_rows(lens: Lens) -> None:
    rectifier, left, right = flight(lens, TURNED)
    before, found_before = measured(rectifier, left, right)
    rows = RowAlignment(rectifier, RowConfig())
    disparity = np.full(len(UV), rectifier.camera.bf / DEPTH_M)
    rows.add(
        build_pyramid(rectifier.left(left), LEVELS),
        build_pyramid(right, LEVELS),
        UV,
        np.zeros(len(UV), np.uint8),
        disparity,
    )
    assert rows.apply() > 0.5
    assert len(rows.take_events()) == 1
    assert rows.take_events() == []
    after, found = measured(rectifier, left, right)
    assert np.sqrt(np.mean(before[found_before] ** 2)) > 0.8
    assert np.sqrt(np.median(after[found] ** 2)) < 0.1
    assert rows.apply() == 0.0  # nothing new


@pytest.mark.parametrize("lens", [Lens.NONE, Lens.RADTAN])
def test_a_true_rig_is_left_alone(lens: Lens) -> None:
    rectifier, left, right = flight(lens, np.zeros(3))
    grid = rectifier.right_grid
    rows = RowAlignment(rectifier, RowConfig())
    disparity = np.full(len(UV), rectifier.camera.bf / DEPTH_M)
    pyramids = build_pyramid(rectifier.left(left), LEVELS), build_pyramid(right, LEVELS)
    rows.add(*pyramids, UV, np.zeros(len(UV), np.uint8), disparity)
    assert rows.apply() == 0.0
    assert rectifier.right_grid is grid


@pytest.mark.parametrize("lens", [Lens.NONE, Lens.RADTAN])
@pytest.mark.parametrize(("turned", "least", "most"), [
    (TURNED, 10.0, np.inf),
    (np.array([0.0, 0.0, 2.5e-3]), 5.0, np.inf),  # twisted about the optical axis: the middle is right
    (np.array([0.0, 1.6e-3, 0.0]), 5.0, np.inf),  # turned about y: corners are off, by half a pixel
    (np.zeros(3), -1.25, -0.9),  # a good calibration: three of ten worn ones show nothing, either
    (np.array([2e-4, 0.0, 0.0]), -1.25, 0.0),  # a tenth of a pixel
    (np.array([0.0, 5e-3, 0.0]), -1.25, 0.5),  # corners are off by more than wear explains: another rectification
])  # fmt: skip
def test_rows_tell_whether_a_rig_is_worn(lens: Lens, turned: F64, least: float, most: float) -> None:
    rectifier, left, right = flight(lens, turned)
    rows = RowAlignment(rectifier, RowConfig())
    assert rows.worn_evidence == 0.0
    disparity = np.full(len(UV), rectifier.camera.bf / DEPTH_M)
    pyramids = build_pyramid(rectifier.left(left), LEVELS), build_pyramid(right, LEVELS)
    rows.add(*pyramids, UV, np.zeros(len(UV), np.uint8), disparity)
    assert least < rows.worn_evidence < most
    assert rows.roll_px is not None
    assert abs(rows.roll_px - told_camera(lens).fx * abs(turned[2])) < 0.12
    fresh = Rectifier(CameraRig(told_camera(lens), told_camera(lens), np.eye(4), T_C_R))
    later = RowAlignment(fresh, RowConfig())
    later.begin_with(rows.estimate_px, read=False)  # from the rig file
    assert (later.worn_evidence > 2.0) == (least > 0.0)


def test_offsets_of_few_points_or_without_texture_count_for_nothing() -> None:
    rectifier, left, right = flight(Lens.NONE, TURNED)
    rows = RowAlignment(rectifier, RowConfig())
    few = UV[:20]
    disparity = np.full(len(few), rectifier.camera.bf / DEPTH_M)
    octave = np.zeros(len(UV), np.uint8)
    rows.add(build_pyramid(left, LEVELS), build_pyramid(right, LEVELS), few, octave[:20], disparity)
    grey = build_pyramid(np.full_like(left, 90), LEVELS)
    rows.add(grey, grey, UV, octave, np.full(len(UV), 10.0))
    assert rows.apply() == 0.0
    off = RowAlignment(rectifier, replace(RowConfig(), on=False))
    off.add(build_pyramid(left, LEVELS), build_pyramid(right, LEVELS), UV, octave, np.full(len(UV), 15.0))
    assert off.apply() == 0.0


@pytest.mark.parametrize("lens", [Lens.NONE, Lens.RADTAN])
@pytest.mark.parametrize("pitch_rad", [0.015, -0.03])  # 6 and 13 rows
def test_rows_that_are_known_to_a_pixel_are_measured_from_there(lens: Lens, pitch_rad: float) -> None:
    turned = np.array([pitch_rad, 0.0, 0.0])
    rectifier, left, right = flight(lens, turned)
    off_px = float(np.round(np.median(expected(rectifier, UV, turned))))
    rows = RowAlignment(rectifier, RowConfig())
    assert rows.read_lower(off_px)
    pyramids = build_pyramid(rectifier.left(left), LEVELS), build_pyramid(right, LEVELS)
    disparity = np.full(len(UV), rectifier.camera.bf / DEPTH_M)
    assert rows.add(*pyramids, UV, np.zeros(len(UV), np.uint8), disparity) > 0
    rows.apply()  # also less than half a pixel
    assert len(rows.take_events()) == 1
    offset, found = measured(rectifier, left, right)
    assert found.mean() > 0.7
    assert np.sqrt(np.median(offset[found] ** 2)) < 0.15
    assert np.abs(rows.at(UV) - expected(rectifier, UV + [disparity[0], 0.0], turned)).max() < 0.3
    rows.add(*pyramids, UV, np.zeros(len(UV), np.uint8), disparity)
    assert rows.apply() == 0.0


def test_rows_that_are_off_by_less_than_a_pixel_need_no_search() -> None:
    rectifier, _, _ = flight(Lens.RADTAN, TURNED)
    grid = rectifier.right_grid
    assert not RowAlignment(rectifier, RowConfig()).read_lower(0.9)
    assert not RowAlignment(rectifier, replace(RowConfig(), on=False)).read_lower(9.0)
    assert rectifier.right_grid is grid


@pytest.mark.parametrize("lens", [Lens.NONE, Lens.RADTAN])
def test_the_right_half_image_follows(lens: Lens) -> None:
    rectifier, _, right = flight(lens, TURNED)
    half = build_pyramid(right, 2)[1]
    before = rectifier.halved(1, half).astype(np.float64)
    rectifier.set_right_rows(lambda uv: np.full(len(uv), 4.0))  # two rows of level 1
    after = rectifier.halved(1, half).astype(np.float64)
    inside = np.s_[30:150, 30:280]
    lower = np.roll(before, -2, axis=0)
    assert np.mean(np.abs(after[inside] - lower[inside])) < 0.2 * np.mean(np.abs(after[inside] - before[inside]))


def test_terms_describe_small_rotations() -> None:
    rectifier, _, _ = flight(Lens.NONE, TURNED)
    at = terms((UV - [0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)]) / FOCAL)
    rows = expected(rectifier, UV + [rectifier.camera.bf / DEPTH_M, 0.0], TURNED)
    left = rows - at @ np.linalg.lstsq(at, rows, rcond=None)[0]
    assert np.abs(left).max() < 0.01


def test_the_next_flight_begins_with_the_rows_and_measures_on() -> None:
    rectifier, left, right = flight(Lens.RADTAN, TURNED)
    pyramids = build_pyramid(rectifier.left(left), LEVELS), build_pyramid(right, LEVELS)
    octave, disparity = np.zeros(len(UV), np.uint8), np.full(len(UV), rectifier.camera.bf / DEPTH_M)
    first = RowAlignment(rectifier, RowConfig())
    assert not first.known
    assert first.take_change() is None  # nothing was measured
    first.add(*pyramids, UV, octave, disparity)
    change = first.take_change()
    assert change is not None
    assert first.known
    assert np.array_equal(change, first.estimate_px)
    first.add(*pyramids, UV, octave, disparity)
    assert first.take_change() is None  # it changed by less than matters

    fresh, _, _ = flight(Lens.RADTAN, TURNED)
    after = RowAlignment(fresh, RowConfig())
    after.begin_with(first.estimate_px, read=True)
    assert np.allclose(after.estimate_px, first.estimate_px)
    offset, found = measured(fresh, left, right)
    assert np.sqrt(np.median(offset[found] ** 2)) < 0.15
    after.add(*pyramids, UV, octave, disparity)
    assert after.take_change() is None
    small = RowAlignment(flight(Lens.RADTAN, TURNED)[0], RowConfig())
    small.begin_with(np.array([0.2, 0.0, 0.0, 0.0, 0.0]), read=False)
    assert not small.applied_px.any()

"""Landmarks of a rolling shutter's keyframe move with their depths, as the camera moved while it was read."""

import numpy as np
import pytest

from kiteline_agent.keyframes.new_landmarks import NewPoints, moved_to_frame, nearby, shown_by_rows
from kiteline_agent.local_map.row_parallax import RowParallax
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_core.geometry.cameras import Rectifier
from kiteline_hw.sim.sensors.rig import make_rig

RECTIFIER = Rectifier(make_rig())
CAMERA = RECTIFIER.camera
SHUTTER = RollingShutter(
    CAMERA, 0.02, CAMERA.height, RECTIFIER.left_grid, np.array([0.8, -0.5, 0.9, 0.6, -0.7, 0.5])
)  # fmt: skip
FOCAL = np.array([CAMERA.fx, CAMERA.fy])
N = 80


def points(rho: float) -> NewPoints:
    """Corners over the image, all at one inverse depth; 0: without a depth."""
    uv = np.random.default_rng(3).uniform(40.0, [CAMERA.width - 40.0, CAMERA.height - 40.0], (N, 2))
    disparity = np.full(N, rho * CAMERA.bf if rho > 0.0 else -1.0)
    return NewPoints(uv, disparity, np.zeros(N, np.uint8), np.zeros(N, np.uint8), np.zeros((N, 32), np.uint8))


def test_a_landmark_whose_depth_is_found_later_is_where_it_had_been_with_that_depth() -> None:
    before, true = moved_to_frame(points(0.0), CAMERA, SHUTTER), moved_to_frame(points(0.4), CAMERA, SHUTTER)
    assert np.abs(before.uv - true.uv).max() > 1.0
    kept = RowParallax(3, N)
    kept.set(1, before.row_shift.parallax_m, before.row_shift.rho)
    rows = N + np.arange(N)
    change = kept.change(rows, np.full(N, 0.4))
    assert before.uv + change * FOCAL == pytest.approx(true.uv, abs=0.02)
    assert kept.change(rows, np.full(N, 0.4)) == pytest.approx(0.0)  # once
    assert before.uv + before.row_shift.shift_px == pytest.approx(points(0.0).uv)


def test_with_a_global_shutter_nothing_moves() -> None:
    kept = RowParallax(3, N)
    kept.clear(1)
    assert not kept.any


def test_a_slot_forgets_its_keyframe() -> None:
    kept, moved = RowParallax(2, N), moved_to_frame(points(0.0), CAMERA, SHUTTER)
    kept.set(1, moved.row_shift.parallax_m, moved.row_shift.rho)
    kept.clear(1)
    assert not kept.change(N + np.arange(N), np.ones(N)).any()


def test_a_keyframe_that_is_moved_later_keeps_what_its_depths_change() -> None:
    """Its read-out was unknown: its landmarks are where rows showed them, and are moved as if they were far away."""
    kept, shown = RowParallax(2, N), points(0.0)
    kept.clear(0)
    far, parallax_m = SHUTTER.to_frame_with_parallax(shown.uv, np.zeros(N))
    kept.add(0, parallax_m, np.zeros(N))
    change = kept.change(np.arange(N), np.full(N, 0.4))
    assert far[:, :2] + change * FOCAL == pytest.approx(moved_to_frame(points(0.4), CAMERA, SHUTTER).uv, abs=0.02)


def test_a_bearing_that_the_base_refined_is_right_for_its_depth() -> None:
    kept, moved = RowParallax(2, N), moved_to_frame(points(0.0), CAMERA, SHUTTER)
    kept.set(0, moved.row_shift.parallax_m, moved.row_shift.rho)
    kept.refer(0, np.arange(N), np.full(N, 0.4))
    assert not kept.change(np.arange(N), np.full(N, 0.4)).any()
    assert kept.change(np.arange(N), np.full(N, 0.5)).any()


def test_rows_show_a_landmark_of_the_stamp_where_it_came_from() -> None:
    moved = moved_to_frame(points(0.3), CAMERA, SHUTTER)
    again = shown_by_rows(moved, CAMERA, SHUTTER)
    assert again.row_shift.shift_px == pytest.approx(moved.row_shift.shift_px, abs=0.35)  # of second order
    assert again.row_shift.parallax_m * FOCAL == pytest.approx(moved.row_shift.parallax_m * FOCAL, abs=0.15)


def test_a_motion_in_another_unit_shows_the_same() -> None:
    near, far = points(0.5), points(0.25)
    assert moved_to_frame(near, CAMERA, SHUTTER).uv == pytest.approx(
        moved_to_frame(far, CAMERA, SHUTTER.scaled(2.0)).uv
    )


def test_depths_nearby_are_those_of_the_nearest() -> None:
    places = np.array([[0.0, 0.0], [300.0, 0.0]])
    found = nearby(np.array([[2.0, 0.0], [299.0, 0.0], [150.0, 0.0]]), places, np.array([1.0, 3.0]))
    assert found == pytest.approx([1.0, 3.0, 2.0], abs=1e-3)


def test_without_a_depth_nearby_points_are_far_away() -> None:
    """As in a keyframe of a frame that tracks no landmark."""
    moved = moved_to_frame(points(0.0), CAMERA, SHUTTER, nearby(points(0.0).uv, np.zeros((0, 2)), np.zeros(0)))
    assert np.array_equal(moved.uv, moved_to_frame(points(0.0), CAMERA, SHUTTER).uv)

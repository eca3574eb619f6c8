"""Ground that falls: pits, steps and edges are not free, and slopes that vehicles climb are."""

from typing import Any

import numpy as np
import pytest

from kiteline_core.ground import column_kernels
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ground.level_kernels import BIN_PX
from kiteline_core.ground.segmentation import ExpectedGround
from tests.core.ground.test_segmentation import HEIGHT_M, Surface, level_ground, up, view, wall

KNOWN = ExpectedGround(HEIGHT_M, 0.1)
BEHIND_EDGE_M = 0.05  # a cell
ROW_RAD = 0.0093  # between two rows of a disparity image


def floor_without(near_m: float, far_m: float, half_width_m: float) -> Surface:
    """Level ground with a hole."""

    def hit(o: np.ndarray, r: np.ndarray) -> np.ndarray:
        t = level_ground(o, r)
        finite = np.where(np.isfinite(t), t, 0.0)
        x, y = finite * r[..., 0], finite * r[..., 1]
        return np.where((x > near_m) & (x < far_m) & (np.abs(y) < half_width_m), np.inf, t)

    return hit


def lower_ground(depth_m: float) -> Surface:
    return lambda o, r: level_ground(o, r) * ((HEIGHT_M + depth_m) / HEIGHT_M)


def freed_m(scan: ColumnScan, near_m: float, far_m: float, half_width_m: float) -> float:
    """Longest way that a column says to be free between two distances ahead."""
    ahead = np.cos(scan.azimuths_rad)
    inside = (np.abs(np.tan(scan.azimuths_rad)) * near_m < half_width_m) & (scan.free_m > 0.0)
    begin, end = np.maximum(scan.free_from_m * ahead, near_m), np.minimum(scan.free_m * ahead, far_m)
    return float((end - begin)[inside].max(initial=0.0))


@pytest.mark.parametrize("pitch_deg", [8.0, 30.0])
@pytest.mark.parametrize(("depth_m", "length_m"), [(1.0, 1.0), (0.3, 0.6), (30.0, 0.7)])
def test_free_ground_ends_before_a_pit(depth_m: float, length_m: float, pitch_deg: float) -> None:
    near, far, half = 2.5, 2.5 + length_m, 0.45
    surfaces = (
        floor_without(near, far, half),
        lower_ground(depth_m),
        wall(far, -HEIGHT_M - depth_m, -HEIGHT_M, half, half),
    )
    for seed in range(2):
        segmenter, disparity = view(up(0.0, pitch_deg), *surfaces, wall(8.0), seed=seed)
        scan = segmenter.segment(disparity, None, up(0.0, pitch_deg), None, KNOWN).scan
        assert freed_m(scan, near, far, half - 0.1) < BEHIND_EDGE_M
        assert np.median(scan.free_m) > 4.0  # beside it


@pytest.mark.parametrize("pitch_deg", [8.0, 20.0, 30.0])
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("depth_m", [0.2, 1.0])
def test_free_ground_does_not_go_on_over_an_edge(depth_m: float, known: bool, pitch_deg: float) -> None:
    """The curve of the ground does not follow a step down."""
    segmenter, disparity = view(up(0.0, pitch_deg), floor_without(3.0, 99.0, 99.0), lower_ground(depth_m), wall(8.0))
    scan = segmenter.segment(disparity, None, up(0.0, pitch_deg), None, KNOWN if known else None).scan
    ahead = np.cos(scan.azimuths_rad)
    over = (scan.free_from_m * ahead < 2.9) & (scan.free_m * ahead > 3.0 + 2.0 * BEHIND_EDGE_M)
    assert over.mean() < 0.05


@pytest.mark.parametrize("fall", [0.08, 0.15])
def test_a_slope_down_is_ground(fall: float) -> None:
    """Level up to 3 m ahead, then down."""

    def slope(o: np.ndarray, r: np.ndarray) -> np.ndarray:
        level = level_ground(o, r)
        down = -fall * r[..., 0] - r[..., 2]
        on_slope = np.where(down > 1e-6, (HEIGHT_M - 3.0 * fall) / np.maximum(down, 1e-6), np.inf)
        return np.where(level * r[..., 0] < 3.0, level, on_slope)

    segmenter, disparity = view(up(), slope)
    scan = segmenter.segment(disparity, None, up()).scan
    assert (scan.free_m > 4.5).mean() > 0.9


def behind_a_low_box(wall_m: float) -> float:
    """Where free ground ends that is seen over a low box up to 3.5 m, with a wall beyond."""
    bf, bins, height = 25.0, 192, 1.5
    centres = bf / ((np.arange(bins) + 0.5) * BIN_PX)
    grounds, obstacles, none = np.zeros((3, 1, bins), np.int32)
    grounds[0, (centres > 2.6) & (centres < 3.5)] = 20
    obstacles[0, int(bf / wall_m / BIN_PX)] = 40
    free_from, free, obstacle, clear = np.zeros((4, 1))
    column_kernels.collect_scan(
        grounds, -height * grounds.astype(float), obstacles, none, none, 5, np.array([[bf / 2.0, 0.0]]),
        np.array([1], np.uint8), np.array([0.1, 0.5, 1.2, 2.0]), height, np.zeros(1), bf, ROW_RAD, 10, 0.25, 0.25,
        free_from, free, obstacle, clear,
    )  # fmt: skip
    return float(free[0])


def test_a_wall_beyond_a_gap_is_not_what_ends_free_ground() -> None:
    """Free ground ends earlier where nothing is seen beyond: a pit may begin there."""
    assert behind_a_low_box(4.5) == behind_a_low_box(20.0) < behind_a_low_box(3.6)


def free_to_from_low_above(looks_into_hole: int) -> float:
    """Where free ground ends that a camera 0.4 m above sees in rows, without that at 3.3 m; pixels of a hole there."""
    bf, bins, height = 25.0, 192, 0.4
    grounds, astray, none = np.zeros((3, 1, bins), np.int32)
    rows_m = height / np.tan(ROW_RAD * np.arange(10, 40))
    rows_m = rows_m[np.abs(rows_m - 3.3) > 0.15]
    grounds[0, (bf / rows_m / BIN_PX).astype(int)] = 5
    astray[0, int(bf / 3.3 / BIN_PX)] = looks_into_hole
    free_from, free, obstacle, clear = np.zeros((4, 1))
    column_kernels.collect_scan(
        grounds, -height * grounds.astype(float), none, none, astray, 5, np.zeros((1, 2)), np.zeros(1, np.uint8),
        np.array([0.1, 0.5, 1.2, 2.0]), height, np.zeros(1), bf, ROW_RAD, 10, 0.25, 0.25, free_from, free, obstacle,
        clear,
    )  # fmt: skip
    return float(free[0])


def test_rows_that_lie_far_apart_on_the_ground_are_no_gap_unless_they_show_a_hole() -> None:
    assert free_to_from_low_above(0) > 3.9
    assert 2.3 < free_to_from_low_above(5) < 3.1


def test_ground_below_nearer_ground_by_more_than_a_slope_is_a_step() -> None:
    """Compared with sums that are taken anew for each pair of bins."""
    random, bf, bins = np.random.default_rng(0), 25.0, 160
    grounds = random.integers(0, 12, bins).astype(np.int32) * (random.random(bins) < 0.8)
    z = -1.5 - 0.15 * (np.arange(bins) < 50) + random.normal(0.0, 0.01, bins)
    heights = grounds * z
    means, steps = np.empty(bins), np.empty(bins, np.bool_)
    kernel: Any = column_kernels._mark_steps
    kernel.py_func(grounds, heights, bf, 10, means, steps)

    def is_step(j: int) -> bool:
        low, n = heights[max(j - 1, 0) : j + 1].sum(), grounds[max(j - 1, 0) : j + 1].sum()
        for k in range(j + 2, bins - 1):
            apart = bf / ((j + 0.5) * BIN_PX) - bf / ((k + 0.5) * BIN_PX)
            m = grounds[k - 1 : k + 2].sum()
            if n >= 8 and m >= 8 and apart <= 0.8 and heights[k - 1 : k + 2].sum() / m - low / n > 0.06 + 0.15 * apart:
                return True
        return False

    expected = [is_step(j) for j in range(10, bins)]
    assert any(expected)
    assert steps[10:].tolist() == expected

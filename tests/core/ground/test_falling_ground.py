"""Ground that falls: pits, steps and edges are not free, and slopes that vehicles climb are."""

from __future__ import annotations

import numpy as np
import pytest

from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ground.segmentation import ExpectedGround
from tests.core.ground.test_segmentation import HEIGHT_M, Surface, level_ground, up, view, wall

KNOWN = ExpectedGround(HEIGHT_M, 0.1)
BEHIND_EDGE_M = 0.05  # a cell


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

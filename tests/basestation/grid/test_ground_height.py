"""Ground and labels of landmarks where there are no scans."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid import sparse_kernels as kernels
from kiteline_basestation.grid.ground_height import ground_heights
from kiteline_basestation.grid.sparse_scan import GROUND, OBSTACLE, UNLABELLED, label
from kiteline_core.arrays import F64, I64


def test_ground_is_the_floor_and_neither_a_table_nor_noise_below() -> None:
    rng = np.random.default_rng(1)
    floor = np.column_stack([rng.uniform(0, 4, (200, 2)), rng.normal(0.0, 0.01, 200)])
    table = np.column_stack([rng.uniform(1, 3, (500, 2)), rng.normal(0.7, 0.01, 500)])
    noise = np.column_stack([rng.uniform(0, 4, (30, 2)), rng.uniform(-2.0, -0.2, 30)])
    points = np.concatenate([floor, table, noise])
    ground = ground_heights(points, np.full(len(points), 1.2))
    np.testing.assert_allclose(ground, 0.0, atol=0.06)


def test_labels_follow_height_and_distance() -> None:
    height = np.array([-0.5, -0.05, 0.05, 0.12, 0.12, 1.9, 2.1, np.nan])
    distance = np.array([1.0, 1.0, 1.0, 0.0, 10.0, 1.0, 1.0, 1.0])
    expected = [UNLABELLED, GROUND, GROUND, OBSTACLE, GROUND, OBSTACLE, UNLABELLED, UNLABELLED]
    assert label(GridConfig(), height, distance).tolist() == expected


def test_ground_that_is_known_about_is_found_below_a_box_that_shows_more() -> None:
    rng = np.random.default_rng(2)
    floor = np.column_stack([rng.uniform([1, -2], [5, 2], (40, 2)), rng.normal(-1.0, 0.01, 40)])
    box = np.column_stack([rng.uniform([1, -2], [3, 2], (500, 2)), rng.normal(-0.6, 0.01, 500)])
    points = np.concatenate([floor, box])
    assert ground_heights(points, np.zeros(540)) == pytest.approx(-0.6, abs=0.1), "lowest peak"
    known = ground_heights(points, np.zeros(540), np.array([-1.08, 0.0, 0.0]))
    assert known == pytest.approx(-1.0, abs=0.05)
    floor[:, 2] += 0.2 * floor[:, 0] - 0.1 * floor[:, 1]
    known = ground_heights(floor, np.full(40, 1.0), np.array([-1.0, 0.2, -0.1]))
    assert known == pytest.approx(floor[:, 2], abs=0.08)


def ground_reference(count: F64, seed: int, seed_bin: int, reach: int, share: float, least: float) -> I64:
    rows, columns, bins = count.shape
    ground = {(seed // columns, seed % columns): seed_bin}
    queue = list(ground)
    while queue:
        r, c = queue.pop(0)
        for place in ((r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)):
            if place in ground or not (0 <= place[0] < rows and 0 <= place[1] < columns):
                continue
            window = range(max(0, ground[r, c] - reach), min(bins - 1, ground[r, c] + reach) + 1)
            h = count[place]
            need = max(share * max(h[b] for b in window), least)
            peaks = [b for b in window if h[b] >= need and (b == window[-1] or h[b] >= h[b + 1])]
            ground[place] = peaks[0] if peaks else ground[r, c]
            queue.append(place)
    return np.array([[ground[r, c] for c in range(columns)] for r in range(rows)])


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_ground_spreads_as_in_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = rng.integers(0, 9, (rng.integers(1, 5), rng.integers(1, 5), 20)).astype(np.float32)
    start, start_bin, reach = int(rng.integers(count.shape[0] * count.shape[1])), int(rng.integers(20)), 3
    ground = np.zeros(count.shape[:2], np.int32)
    kernels.spread_ground(count, start, start_bin, reach, 0.25, 4.0, ground, np.zeros(ground.size, np.int32))
    assert np.array_equal(ground, ground_reference(count.astype(float), start, start_bin, reach, 0.25, 4.0))

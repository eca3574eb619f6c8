"""What of a scan is kept, and the sectors that are drawn of it, against the rules column by column."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.kept_scan import KeptScan, keep
from kiteline_basestation.grid.sectors import sectors_of
from kiteline_codec.schema.base.grid_tile import MAX_STOREY
from kiteline_core.arrays import F64
from kiteline_core.geometry import sim3
from kiteline_core.ground.column_scan import ColumnScan
from tests.basestation.flat_rooms import camera

CONFIG = replace(GridConfig(), side_columns=2)
N = 24
BF = 60.0  # px m
HIT = 12
_LAST_M = MAX_STOREY * CONFIG.storey_m  # height of the last storey above the middle one


def random_scan(seed: int) -> ColumnScan:
    """Walls, lone obstacles, tables, ground that ends before, at or behind them, and columns without anything."""
    rng = np.random.default_rng(seed)
    solid, start = rng.random(N) < 0.7, rng.uniform(0.3, 0.9, N)
    near = np.where(rng.random(N) < 0.6, rng.uniform(1.0, 4.0) / np.cos(np.arange(N) * 0.05), rng.uniform(0.2, 16.0, N))
    near[rng.random(N) < 0.05] = 0.0  # the vehicle itself
    start = np.where(rng.random(N) < 0.2, rng.uniform(0.5, 6.0, N), start)
    kind = rng.integers(0, 4, N)
    free = np.where(kind == 0, near, np.where(kind == 1, near * rng.uniform(0.3, 1.0, N), rng.uniform(0.3, 9.0, N)))
    free = np.where(kind == 3, np.where(rng.random(N) < 0.5, 0.0, 60.0), free)
    bands = np.where(solid, rng.integers(1, 8, N), 0).astype(np.uint8)
    return ColumnScan(
        np.array([0.0, -1.0, 0.0]), -0.3, float(rng.choice([0.02, 0.05, 0.2])), np.where(free > 0.0, start, 0.0), free,
        np.where(solid, near, np.inf), bands, rng.uniform(0.0, 9.0, N), float(rng.uniform(0.02, 2.4)),
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.0, BF, 400.0]))
def test_ranges_are_kept_as_far_as_they_are_known_and_free_up_to_what_stands_there(seed: int, bf: float) -> None:
    scan = random_scan(seed)
    kept = keep(CONFIG, scan, bf)
    assert kept is not None
    sigma = CONFIG.sigma_px / bf if bf else 0.0
    limit = min(CONFIG.max_range_m, math.sqrt(CONFIG.max_sigma_m / sigma)) if bf else CONFIG.max_range_m
    q1, q3 = np.quantile(scan.free_m[scan.free_m > 0.0], (0.25, 0.75))
    expected = np.zeros((5, N))
    for i in range(N):
        near = float(scan.obstacle_m[i]) if scan.bands[i] else math.inf
        before = math.inf  # an obstacle that is too far to be drawn is uncertain, too
        if limit < near < math.inf:
            before = near - max(3.0 * sigma * near**2, CONFIG.cell_m)
        free = min(float(scan.free_m[i]), limit, q3 + 1.5 * (q3 - q1), before)
        if free > scan.free_from_m[i]:
            expected[2:4, i] = scan.free_from_m[i], free
        expected[4, i] = max(min(float(scan.clear_m[i]), limit, near, before), 0.0)
        expected[:2, i] = (near, scan.bands[i]) if near <= limit else (math.inf, 0)
    np.testing.assert_allclose(kept.ranges(), expected, atol=0.5 / 256 + 1e-9)
    drawn = kept.ranges()[[0, 3, 4]]
    assert kept.reach_m == max(drawn[np.isfinite(drawn)].max(), CONFIG.cell_m)
    assert kept.first_rad == pytest.approx(scan.azimuth0_rad - 0.5 * scan.azimuth_step_rad, abs=1e-5)


def edges(kept: KeptScan, middle: F64, solid: list[bool]) -> F64:
    """Ranges (N,3) of obstacles: inverse ranges are linear between two columns that see one surface."""
    inverse = [1.0 / middle[i] if solid[i] else 0.0 for i in range(N)]

    def between(i: int, k: int) -> float | None:
        if not (i >= 0 and k < N and solid[i] and solid[k]):
            return None
        one = abs(inverse[i] - inverse[k]) < min(4.0 * kept.step, 0.5) * min(inverse[i], inverse[k])
        return 0.5 * (inverse[i] + inverse[k]) if one else None

    out = np.full((N, 3), np.inf)
    for i in np.flatnonzero(solid).tolist():
        lower, upper = between(i - 1, i), between(i, i + 1)
        if lower is None:
            lower = 2.0 * inverse[i] - (inverse[i] if upper is None else upper)
        out[i] = 1.0 / lower, 1.0 / inverse[i], 1.0 / (2.0 * inverse[i] - lower if upper is None else upper)
    return out


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.7, 1.0, 1.9]), st.sampled_from([BF, 400.0]))
def test_sectors_follow_the_rules_column_by_column(seed: int, scale: float, bf: float) -> None:
    kept = keep(CONFIG, random_scan(seed), bf)
    assert kept is not None
    lattice = kept.lattice(CONFIG, sim3.of(scale, camera(0.3, -0.2, 0.5)))
    found = sectors_of(CONFIG, kept, lattice, HIT)
    unit, ranges = lattice.scale / 1024 / CONFIG.cell_m, kept.ranges()
    solid = [bool(ranges[1, i] > 0 and ranges[0, i] > 0) for i in range(N)]
    obstacle = edges(kept, ranges[0] * unit, solid)
    azimuth = kept.first_rad + kept.step * (np.arange(N) + 0.5)
    seen = ranges[3] > 0.0
    border = float(np.quantile((ranges[2] * np.cos(azimuth))[seen], 0.1)) if seen.any() else 0.0
    accurate_m = math.sqrt(0.05 / kept.sigma_per_m2)
    for i in range(N):
        near_m, _, start_m, free_m, clear_m = ranges[:, i].tolist()
        low_too = solid[i] and bool(int(ranges[1, i]) & 1)  # the obstacle reaches into the lowest band
        sigma = kept.sigma_per_m2 * unit
        gap = max(1.0, 3.0 * sigma * near_m**2) if solid[i] else 1.0
        before, free = obstacle[i] - gap, free_m * unit
        behind = start_m > near_m
        if free == 0.0:
            end = np.zeros(3)
        elif behind and low_too:
            end = np.full(3, free)
        elif free_m >= near_m and not behind:
            end = before
        else:
            end = np.minimum(free, before)
        margin, last_m = (2.0, near_m) if solid[i] else (1.0, free_m)
        sure = max(end.min() - margin * sigma * last_m**2, 0.0)
        fair = max(end.min() - (margin - 1.0) * sigma * last_m**2, 0.0)
        begin = start_m * unit
        at_side = min(i, N - 1 - i) < CONFIG.side_columns
        if not (at_side or behind or start_m * math.cos(azimuth[i]) > 1.25 * border):
            begin *= max(0.0, 1.0 - CONFIG.bands_m[0] / kept.height_m)
        np.testing.assert_allclose(found.obstacle[i], obstacle[i], rtol=1e-12)
        assert found.bands[i] == (ranges[1, i] if solid[i] else 0)
        if solid[i]:
            assert found.weight[i] == max(1, round(HIT * min(1.0, accurate_m / near_m)))
        assert [found.start[i], found.begin[i]] == pytest.approx([start_m * unit, begin])
        np.testing.assert_allclose(found.end[i], end, rtol=1e-12, atol=1e-9)
        assert [found.low[i], found.under[i]] == pytest.approx([0.0, 0] if low_too else [free, 1])
        assert found.clear[i] == pytest.approx(min(clear_m * unit, before.min()))
        views = found.accurate[i], found.sure[i], found.fair[i]
        assert views == pytest.approx((0.0, 0.0, 0.0) if at_side else (accurate_m / CONFIG.cell_m, sure, fair))
    bands = itertools.pairwise(CONFIG.bands_m)
    assert found.camera_band == next((b for b, (low, high) in enumerate(bands) if low <= kept.height_m < high), -1)
    row0, column0, row1, column1 = found.box()
    reach = max(found.end.max(), found.low.max(), found.clear.max(), obstacle[solid].max(initial=0.0))
    heading = found.first_rad + np.linspace(0.0, N * kept.step, 200)
    x, y = found.x + reach * np.cos(heading), found.y + reach * np.sin(heading)
    assert 64 * row0 <= min(y.min(), found.y) and max(y.max(), found.y) < 64 * row1
    assert 64 * column0 <= min(x.min(), found.x) and max(x.max(), found.x) < 64 * column1


@pytest.mark.parametrize(("scale", "unit_m"), [(1.0, 1.0), (2.0, 1.0), (2.0, 4.0)])
@pytest.mark.parametrize("ground_m", [0.0, 3.1, -2.2, 1e4, -1e4, _LAST_M, -_LAST_M - CONFIG.storey_m])
def test_a_scan_lies_on_the_storeys_around_its_ground(scale: float, unit_m: float, ground_m: float) -> None:
    """Lengths of a scan that was made in another unit count in w; no storey is beyond those that tiles have."""
    kept = keep(CONFIG, random_scan(1), BF, unit_m)
    assert kept is not None
    pose = camera(1.0, 2.0, 0.7)
    pose[2, 3] = CONFIG.ground_m + ground_m + scale / unit_m * kept.height_m
    lattice = kept.lattice(CONFIG, sim3.of(scale, pose))
    near = ground_m / CONFIG.storey_m
    overlap = CONFIG.storey_overlap_m / CONFIG.storey_m
    storeys = range(-MAX_STOREY - 1, MAX_STOREY + 1)
    assert lattice.storeys == tuple(s for s in storeys if round(near - overlap) <= s <= round(near + overlap))
    assert lattice.scale == round(scale / unit_m * 1024)
    assert (lattice.x, lattice.y) == (round(4 / CONFIG.cell_m), round(8 / CONFIG.cell_m))
    turn = lattice.heading * CONFIG.cell_m / 4 / kept.reach_m
    assert turn == pytest.approx(0.7, abs=CONFIG.cell_m / 4 / kept.reach_m) == kept.heading_rad(CONFIG, lattice)

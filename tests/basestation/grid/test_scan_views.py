"""What single views free, and what several say together."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_basestation.grid.kept_scan import GAP_SIGMAS, keep
from kiteline_basestation.grid.scan_grid import ScanGrid, ViewWeights
from kiteline_basestation.grid.sectors import _FAIR_SIGMAS, _OPEN_SIGMAS, _SURE_SIGMAS
from kiteline_basestation.grid.tile_store import Place
from kiteline_core.ground.column_scan import ColumnScan
from tests.basestation.flat_rooms import HEIGHT_M, ROOM, box, camera, scan_of
from tests.basestation.grid_scans import BF, CONFIG, at, kept

WEIGHTS = ViewWeights()


def bare(free_from_m: float, free_m: float) -> ColumnScan:
    """Free ground without an obstacle, over 80 degrees."""
    n = 70
    return ColumnScan(
        np.array([0.0, -1.0, 0.0]), -0.69, 0.02, np.full(n, free_from_m), np.full(n, free_m), np.full(n, np.inf),
        np.zeros(n, np.uint8), np.zeros(n), HEIGHT_M,
    )  # fmt: skip


def test_one_view_at_the_side_of_an_image_frees_nothing() -> None:
    """What stands there is seen in part, and matched worst: a view from elsewhere has to agree."""
    near = bare(0.5, 1.8)
    config = replace(CONFIG, side_columns=5, hole_neighbours=9)
    grid = ScanGrid(config)
    grid.put(0, kept(near, config), camera(0.0, 0.0, 0.0))
    middle, left, right = (1.2 * np.array([np.cos(a), np.sin(a)]) for a in (0.0, 0.66, -0.66))
    assert [int(at(grid, *place)) for place in (middle, left, right)] == [0, -1, -1]
    grid.put(1, kept(near, config), camera(0.0, 0.0, 0.3))
    assert [int(at(grid, *place)) for place in (middle, left, right)] == [0, 0, -1]


def test_each_cell_of_a_scan_is_freed_once() -> None:
    """Sectors share no cell and leave none out, whatever the heading."""
    config = replace(CONFIG, storey_overlap_m=0.0, opening=False, bands_m=(0.0, 0.5, 1.2, 2.0))
    rng = np.random.default_rng(3)
    for heading in [*np.arange(8) * np.pi / 4, *rng.uniform(-4, 4, 12)]:
        wide = bare(0.5, 6.0)
        x, y = rng.uniform(-1, 1, 2).round(2)
        grid = ScanGrid(config)
        grid.put(0, kept(wide, config), camera(x, y, heading))
        counted = 0
        for place in grid.places:
            odds = grid.log_odds(place)
            views = WEIGHTS[1:]
            assert set(np.unique(odds)) <= {0, *(-view for view in views)}
            column, row = np.arange(64) + 64 * place.column, np.arange(64) + 64 * place.row
            dx, dy = (column[None, :] + 0.5) * 0.05 - x, (row[:, None] + 0.5) * 0.05 - y
            r, a = np.hypot(dx, dy), np.arctan2(dy, dx) - heading
            a = (a + np.pi) % (2 * np.pi) - np.pi
            sure = (np.abs(r - 3.25) < 2.7) & (np.abs(a) < 0.69)
            assert (odds[:, sure] < 0).all()
            assert not odds[:, (r > 6.06) | (r < 0.45) | (np.abs(a) > 0.71)].any()
            counted += np.count_nonzero(odds[0])
        assert counted == pytest.approx(1.4 / 2 * (36 - 0.25) / 0.0025, rel=0.01)


def test_a_table_leaves_the_floor_below_it_and_nothing_is_known_behind_a_wall() -> None:
    table = scan_of(np.array(box(-3.0, -3.0, 3.0, 3.0)), 0.0, 0.0, 0.0)
    under = replace(table, obstacle_m=np.full(84, 2.03), bands=np.full(84, 2, np.uint8), free_m=np.full(84, 2.8))
    config = replace(CONFIG, opening=False)
    grid = ScanGrid(config)
    grid.put(0, kept(under, config), camera(0.0, 0.0, 0.0))
    odds = grid.log_odds(Place(0, 0, 0))
    assert odds[1, 2, 40] > 0 > odds[0, 2, 40], "top and floor at 2 m"
    assert odds[0, 2, 50] < 0 and odds[1, 2, 50] == odds[2, 2, 50] == 0
    over = replace(under, bands=np.ones(84, np.uint8), free_from_m=np.full(84, 2.4))
    grid.put(0, kept(over, config), camera(0.0, 0.0, 0.0))
    odds = grid.log_odds(Place(0, 0, 0))
    assert (odds[:, 2, 50] < 0).all() and not odds[:, 2, 43:46].any(), "seen over it, and hidden by it"
    assert not odds[[0, 2], 2, :38].any()
    solid = replace(under, bands=np.full(84, 3, np.uint8))
    grid.put(0, kept(solid, config), camera(0.0, 0.0, 0.0))
    assert not grid.log_odds(Place(0, 0, 0))[:, 2, 42:].any()


def test_cells_over_which_the_nearest_rays_to_the_ground_pass_low_are_free_by_two_views() -> None:
    """Nothing that stands there is higher than the lowest band begins, or the ray would end on it; a pit may be there.

    One view that sees the far edge of a pit at the lower border of its image does not free the pit.
    """
    seen = kept(bare(2.0, 4.0))
    grid = ScanGrid(CONFIG)
    grid.put(0, seen, camera(0.0, 0.0, 0.0))
    near, first = Place(0, 0, 0), 2.0 * (1.0 - CONFIG.bands_m[0] / HEIGHT_M)
    odds = grid.log_odds(near)[:, 1]
    columns = (np.arange(64) + 0.5) * 0.05
    assert (odds[:, (columns > first + 0.05) & (columns < 1.95)] == -WEIGHTS.free_far).all()
    assert not odds[:, columns < first - 0.05].any()
    assert grid.cells(near)[0][1, 38] == -1
    grid.put(1, seen, camera(0.01, 0.0, 0.3))
    assert grid.cells(near)[0][1, 38] == 0


def test_a_far_view_frees_alone_what_lies_well_before_its_obstacle_and_two_what_lies_close() -> None:
    """A far box and the wall behind it are one surface: between them nothing is free by one look from afar."""
    bf = 48.0
    found = keep(CONFIG, scan_of(np.array(box(-5.53, -5.53, 5.53, 5.53)), 0.0, 0.0, 0.0), bf)
    grid = ScanGrid(CONFIG)
    grid.put(0, found, camera(0.0, 0.0, 0.0))
    row = np.concatenate([grid.log_odds(Place(0, 0, k))[0, 1] for k in range(2)])
    columns = (np.arange(128) + 0.5) * CONFIG.cell_m
    sigma_m = CONFIG.sigma_px / bf * 5.53**2
    end = 5.53 - GAP_SIGMAS * sigma_m
    sure, fair = (end - n * sigma_m for n in (_SURE_SIGMAS, _SURE_SIGMAS - _FAIR_SIGMAS))
    near = found.accurate_m(CONFIG)
    assert near + 0.2 < sure < end - 0.2
    assert (row[(columns > near + 0.1) & (columns < sure - 0.1)] == -WEIGHTS.free_sure).all()
    assert (row[(columns > sure + 0.06) & (columns < fair - 0.06)] == -WEIGHTS.free_fair).all()
    assert (row[(columns > fair + 0.06) & (columns < end - 0.06)] == -WEIGHTS.free_far).all()
    assert not (row[columns > end + 0.1] < 0).any()
    assert at(grid, 0.5 * (near + sure), 0.0) == 0 and at(grid, end - 0.15, 0.0) == -1
    grid.put(1, found, camera(0.02, 0.0, 0.0))
    assert at(grid, end - 0.15, 0.0) == 0


def test_a_fair_view_frees_alone_where_no_sign_of_an_obstacle_is_near() -> None:
    """What one view frees wrongly lies beside something that another one saw, nearly always."""
    bf, end = 48.0, 5.0
    ground = keep(CONFIG, bare(1.0, end), bf)
    place = end - 0.5 * _OPEN_SIGMAS * CONFIG.sigma_px / bf * end**2
    grid = ScanGrid(CONFIG)
    grid.put(0, ground, camera(0.0, 0.0, 0.0))
    assert at(grid, place, 0.0) == 0
    nothing, one = np.zeros(70), np.arange(70) == 35
    thing = replace(
        bare(1.0, end), free_from_m=nothing, free_m=nothing, obstacle_m=np.where(one, place + 0.08, np.inf),
        bands=one.astype(np.uint8),
    )  # fmt: skip
    grid.put(1, keep(CONFIG, thing, bf), camera(0.0, 0.0, 0.0))
    assert at(grid, place + 0.08, 0.02) == -1, "one far view of an obstacle is a sign, no obstacle"
    assert at(grid, place, 0.0) == -1 and at(grid, place, 0.6) == 0


def test_a_far_view_of_ground_that_ends_before_no_obstacle_frees_alone_nearly_up_to_its_end() -> None:
    bf, end = 48.0, 5.0
    found = keep(CONFIG, bare(1.0, end), bf)
    grid = ScanGrid(CONFIG)
    grid.put(0, found, camera(0.0, 0.0, 0.0))
    row = np.concatenate([grid.log_odds(Place(0, 0, k))[0, 1] for k in range(2)])
    columns = (np.arange(128) + 0.5) * CONFIG.cell_m
    sure = end - _OPEN_SIGMAS * CONFIG.sigma_px / bf * end**2
    assert (row[(columns > found.accurate_m(CONFIG) + 0.1) & (columns < sure - 0.06)] == -WEIGHTS.free_sure).all()
    assert (row[(columns > sure + 0.06) & (columns < end - 0.06)] == -WEIGHTS.free_fair).all()
    assert sure > end - _SURE_SIGMAS * CONFIG.sigma_px / bf * end**2 + 0.1


@given(st.floats(0.0, 1.2), st.floats(1.0, 2.2))
def test_a_wall_that_is_seen_aslant_is_drawn_as_a_line(turn: float, far_m: float) -> None:
    """Columns are wider than cells, and the range of such a wall changes within one."""
    along, normal = np.array([-np.sin(turn), np.cos(turn)]), np.array([np.cos(turn), np.sin(turn)])
    a, b = far_m * normal - 30.0 * along, far_m * normal + 30.0 * along
    grid = ScanGrid(replace(CONFIG, opening=False, storey_overlap_m=0.0))
    grid.put(0, kept(scan_of(np.array([(*a, *b)]), 0.0, 0.0, 0.0, columns=48)), camera(0.0, 0.0, 0.0))
    for place in grid.places:
        odds = grid.log_odds(place)[0]
        x = (np.arange(64) + 64 * place.column + 0.5) * CONFIG.cell_m
        y = (np.arange(64) + 64 * place.row + 0.5) * CONFIG.cell_m
        before = far_m - (x[None, :] * normal[0] + y[:, None] * normal[1])
        azimuth, reach = np.arctan2(y[:, None], x[None, :]), np.hypot(x[None, :], y[:, None])
        inner = (np.abs(azimuth) < 0.70) & (reach < 6.0) & (np.abs(azimuth - turn) < 1.2)
        assert (np.abs(before[inner & (odds > 0)]) < 1.0 * CONFIG.cell_m).all(), "hits lie on the wall"
        assert (before[inner & (odds < 0)] > 0.5 * CONFIG.cell_m).all(), "nothing behind it is free"


def test_ground_that_was_seen_over_a_low_obstacle_is_free_and_what_it_hides_is_unknown() -> None:
    seen = scan_of(np.array(box(-3.0, -3.0, 3.0, 3.0)), 0.0, 0.0, 0.0)
    over = replace(
        seen, obstacle_m=np.full(84, 1.03), bands=np.full(84, 1, np.uint8), free_from_m=np.full(84, 1.8),
        free_m=np.full(84, 2.6), clear_m=np.zeros(84),
    )  # fmt: skip
    grid = ScanGrid(replace(CONFIG, opening=False))
    grid.put(0, kept(over), camera(0.0, 0.0, 0.0))
    odds = grid.log_odds(Place(0, 0, 0))
    assert odds[:, 2, 20].max() > 0 and not odds[0, 2, :20].any()
    assert not odds[0, 2, 23:35].any(), "hidden"
    assert (odds[0, 2, 38:50] < 0).all(), "seen behind it"


def test_a_view_counts_by_how_accurate_it_is_not_by_how_far() -> None:
    wall = scan_of(np.array(box(-12.03, -12.03, 12.03, 12.03)), 0.0, 0.0, 0.0)
    for bf, expected in ((30.0, 0), (400.0, round(12 * np.sqrt(0.05 * 400.0 / 0.3) / 12.03)), (2000.0, 12)):
        found = keep(CONFIG, wall, bf)
        assert found is not None
        grid = ScanGrid(CONFIG)
        grid.put(0, found, camera(0.0, 0.0, 0.0))
        assert grid.log_odds(Place(0, 0, 240 // 64))[0, 2, 240 % 64] == expected


def test_overlong_and_far_rays_are_cut_and_unknown_ground_is_not_drawn() -> None:
    scan = scan_of(ROOM, 3.0, -2.0, 0.0)
    long = scan.free_m.copy()
    long[40] = 19.5
    bare = replace(scan, free_m=long, obstacle_m=np.full(84, np.inf), bands=np.zeros(84, np.uint8))
    found = keep(CONFIG, bare, 1e4)
    ranges = found.ranges()
    q1, q3 = np.quantile(long[long > 0], (0.25, 0.75))
    assert ranges[3].max() == pytest.approx(q3 + 1.5 * (q3 - q1), abs=0.01)
    near = keep(CONFIG, replace(scan, free_m=np.full(84, 19.0), obstacle_m=np.full(84, 19.0)), 20.0)
    assert near.ranges()[3].max() < np.sqrt(CONFIG.max_sigma_m * 20.0 / CONFIG.sigma_px) + 0.01
    assert np.isinf(near.ranges()[0]).all()
    assert keep(CONFIG, replace(scan, camera_height_m=np.nan), BF) is None


def test_scans_are_drawn_as_far_as_is_asked() -> None:
    for max_range_m in (2.0, 20.0):
        found = keep(replace(CONFIG, max_range_m=max_range_m), scan_of(ROOM, -3.0, 2.5, 0.0), 1e4)
        assert found is not None and (found.reach_m > 2.01) == (max_range_m > 2.0)


def test_nothing_is_free_close_before_an_obstacle_that_is_too_far_to_be_drawn() -> None:
    """Its range is as uncertain as that of one that is drawn."""
    sigma_per_m2 = CONFIG.sigma_px / 20.0
    limit_m = np.sqrt(CONFIG.max_sigma_m / sigma_per_m2)
    for at_m in (1.02 * limit_m, 2.0 * limit_m):
        wall = np.full(84, at_m)
        scan = replace(
            scan_of(ROOM, 3.0, -2.0, 0.0), free_from_m=np.full(84, 0.8), free_m=wall, obstacle_m=wall, clear_m=wall,
            bands=np.full(84, 7, np.uint8),
        )  # fmt: skip
        found = keep(CONFIG, scan, 20.0)
        obstacle, _, _, free, clear = found.ranges()
        assert np.isinf(obstacle).all()
        until_m = min(limit_m, at_m - GAP_SIGMAS * sigma_per_m2 * at_m**2)
        assert free == pytest.approx(until_m, abs=0.01) and clear == pytest.approx(until_m, abs=0.01)

"""Which scans and tiles the local grid counts: each of its limits from both sides."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.config import LocalGridConfig
from kiteline_agent.scans import local_grid
from kiteline_agent.scans.local_grid import SECTORS, LocalGrid
from kiteline_agent.scans.range_error import RangeError
from kiteline_codec.schema import GridTile
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from tests.agent.scans.test_local_grid import (
    BANDS_M,
    CELL_M,
    EAST,
    EXACT,
    TURN,
    WEST,
    room,
    scan_at,
    vehicle,
)

CONFIG = LocalGridConfig()
BEHIND, RIGHT = SECTORS // 2, SECTORS // 4


def distances(grid: LocalGrid, T_w_f: F64, tiles: dict[tuple[int, int], GridTile] | None = None) -> F64:
    found = grid.around(TURN @ T_w_f, T_w_f, tiles or {}, BANDS_M)
    assert found is not None
    return found.distance_m


def doubtful(common_px: float) -> RangeError:
    cov_px = np.zeros_like(EXACT.cov_px)
    cov_px[0, 0] = common_px**2
    return replace(EXACT, cov_px=cov_px)


@pytest.mark.parametrize(("common_px", "counts"), [(0.29, True), (0.31, False)])
def test_tiles_of_a_rig_in_doubt_count_once_as_many_scans_as_are_kept_were_sure(common_px: float, counts: bool) -> None:
    config = replace(CONFIG, scans=3)
    grid, T = LocalGrid(config), vehicle(0.0, 0.0, 0.0)
    grid.add(scan_at(0.0, 0.0, 0.0), doubtful(common_px))
    assert np.isfinite(distances(grid, T, room())[BEHIND]) == counts
    for k, (repeats, sure) in enumerate([(False, counts), (False, counts), (True, counts), (False, True)]):
        grid.add(replace(scan_at(0.0, 0.0, 0.0), repeats=repeats), EXACT)
        assert np.isfinite(distances(grid, T, room())[BEHIND]) == sure, k


def test_of_a_view_that_stays_the_newest_scans_are_kept_beside_all_others() -> None:
    grid = LocalGrid(CONFIG)
    for k in range(3):
        grid.add(scan_at(0.1 * k, 0.0, 0.0), EXACT)
    for k in range(20):
        grid.add(replace(scan_at(0.2 + 0.001 * k, 0.0, 0.0), repeats=True), EXACT)
    assert grid._R_g_o is not None
    kept = [scan_at(x, 0.0, 0.0) for x in (0.0, 0.1, 0.2, *(0.2 + 0.001 * k for k in range(20 - CONFIG.repeats, 20)))]
    expected = [(grid._R_g_o @ scanned.T_o_c[:3, 3])[:2] for scanned in kept]
    np.testing.assert_allclose([(d.x_m, d.y_m) for d in grid._scans], expected, atol=1e-9)


def test_a_better_vertical_that_comes_while_the_view_stays_is_taken() -> None:
    """It leaves out all scans before, of which the newest were repeats."""
    grid, tilt = LocalGrid(CONFIG), se3.so3_exp(np.array([0.15, 0.0, 0.1]))
    for k in range(1 + CONFIG.repeats):
        scanned = scan_at(0.0, 0.0, 0.0)
        tilted = replace(scanned.scan, up_c=tilt @ scanned.scan.up_c)
        grid.add(replace(scanned, scan=tilted, repeats=k > 0), EXACT)
    for _ in range(1 + CONFIG.repeats):
        grid.add(replace(scan_at(0.0, 0.0, 0.0), repeats=True), EXACT)
    assert len(grid._scans) == CONFIG.repeats
    assert distances(grid, vehicle(0.0, 0.0, 0.0))[0] == pytest.approx(EAST, abs=0.1)


AHEAD = [scan_at(0.001 * k, 0.0, 0.0) for k in range(20)]  # more than are drawn in a frame


def test_a_scan_that_comes_while_others_are_drawn_again_is_drawn_too() -> None:
    grid, higher_m = LocalGrid(CONFIG), 1.2 * CONFIG.slab_m
    for scanned in AHEAD:
        grid.add(scanned, EXACT)
    raised = scan_at(0.0, 0.0, 0.0, z=1.0 + higher_m)
    grid.follow(raised.T_o_c)
    assert grid._again
    back = scan_at(0.0, 0.0, np.pi, z=1.0 + higher_m)
    grid.add(back, EXACT)
    for _ in range(5):
        grid.follow(raised.T_o_c)
    assert grid._again is None
    assert distances(grid, vehicle(0.0, 0.0, 0.0, z=1.0 + higher_m))[BEHIND] == pytest.approx(-WEST, abs=0.1)


def test_what_becomes_known_of_ranges_while_scans_are_drawn_again_counts_for_all() -> None:
    grid = LocalGrid(CONFIG)
    for scanned in [scan_at(0.0, 0.0, np.pi), *AHEAD]:
        grid.add(scanned, EXACT)
    raised = scan_at(0.0, 0.0, 0.0, z=1.0 + 1.2 * CONFIG.slab_m)
    grid.follow(raised.T_o_c)
    assert grid._again  # the scan that looks behind is drawn already
    offset_px = np.zeros_like(EXACT.offset_px)
    offset_px[0] = EXACT.bf / -WEST - EXACT.bf / (-WEST + 0.5)
    for _ in range(8):
        grid.follow(raised.T_o_c, replace(EXACT, offset_px=offset_px))
    found = grid._canvas
    assert grid._R_g_o is not None
    behind = grid._R_g_o @ (TURN @ vehicle(WEST - 0.5, 0.0, 0.0))[:3, 3] - [*found.corner, 0.0]
    column, row = (behind[:2] / CONFIG.cell_m).astype(int)
    assert found.cells[row - 2 : row + 3, column - 2 : column + 3].max() > 0


@pytest.mark.parametrize(
    ("higher_m", "far", "near"), [(0.09, True, True), (0.11, False, True), (0.24, False, True), (0.26, False, False)]
)
def test_a_scan_clears_at_its_height_and_shows_what_stands_a_little_beside_it(
    higher_m: float, far: bool, near: bool
) -> None:
    """A wall that is near is told although what lies before it was not seen clear at this height."""
    for x, told in ((0.0, far), (EAST - 1.5, near)):
        grid, z = LocalGrid(CONFIG), 1.0 + higher_m
        grid.add(scan_at(x, 0.0, 0.0), EXACT)
        grid._canvas.fits = False  # drawn anew at the new height
        grid.follow(scan_at(x, 0.0, 0.0, z=z).T_o_c)
        assert np.isfinite(distances(grid, vehicle(x, 0.0, 0.0, z=z))[0]) == told


@pytest.mark.parametrize(("z", "known"), [(1.95, True), (2.05, False)])
def test_tiles_tell_nothing_to_who_is_above_their_bands(z: float, known: bool) -> None:
    grid = LocalGrid(CONFIG)
    grid.add(scan_at(0.0, 0.0, 0.0, z=z), EXACT)
    assert np.isfinite(distances(grid, vehicle(0.0, 0.0, 0.0, z=z), room())[BEHIND]) == known


@pytest.mark.parametrize(("z", "solid"), [(0.24, True), (0.76, False), (0.74, True), (0.94, False), (0.96, True)])
def test_tiles_are_read_in_the_bands_that_the_vehicle_fills(z: float, solid: bool) -> None:
    """Walls of the lowest band and of the highest one; it reaches 0.25 m up and down."""
    for mask in (1, 4):
        grid = LocalGrid(CONFIG)
        grid.add(scan_at(0.0, 0.0, 0.0, z=z), EXACT)
        told = distances(grid, vehicle(0.0, 0.0, 0.0, z=z), room(mask=mask))[BEHIND]
        assert np.isfinite(told) == (solid and (mask == 1) == (z < 0.8))


def test_tiles_are_copied_anew_when_the_vehicle_or_its_height_changes_or_some_are_gone() -> None:
    grid, tiles = LocalGrid(CONFIG), room(mask=1)
    grid.add(scan_at(0.0, 0.0, 0.0, z=0.4), EXACT)
    low, high = vehicle(0.0, 0.0, 0.0, z=0.4), vehicle(0.0, 0.0, 0.0, z=1.5)
    assert np.isfinite(distances(grid, low, tiles)[BEHIND])
    assert not np.isfinite(distances(grid, high, tiles)[BEHIND])
    assert np.isfinite(distances(grid, low, tiles)[BEHIND])
    there = {at: tile for at, tile in tiles.items() if at[0] >= 0}
    assert np.isnan(distances(grid, low, there)[BEHIND])
    other = {**there, **{at: replace(tile, cell_m=2 * CELL_M) for at, tile in tiles.items() if at[0] < 0}}
    assert np.isnan(distances(grid, low, other)[BEHIND])


def test_after_an_unknown_way_nothing_is_told_until_the_next_scan() -> None:
    grid, T = LocalGrid(CONFIG), TURN @ vehicle(0.0, 0.0, 0.0)
    grid.add(scan_at(0.0, 0.0, 0.0), EXACT)
    grid.forget()
    assert grid.around(T, None, {}, BANDS_M) is None
    grid.add(replace(scan_at(0.0, 0.0, np.pi), repeats=True), EXACT)
    told = distances(grid, vehicle(0.0, 0.0, 0.0))
    assert np.isnan(told[0]) and told[BEHIND] == pytest.approx(-WEST, abs=0.1)


def test_all_is_drawn_anew_before_marks_of_scans_are_used_up(monkeypatch: pytest.MonkeyPatch) -> None:
    assert 2 * (local_grid._MOST_DRAWN + CONFIG.scans) + 1 < np.iinfo(np.int16).max
    monkeypatch.setattr(local_grid, "_MOST_DRAWN", 60)
    grid = LocalGrid(CONFIG)
    for k in range(200):
        grid.add(replace(scan_at(0.0, 0.0, 0.0), repeats=k > 0), EXACT)
        assert grid._canvas.number <= 60
    told = distances(grid, vehicle(0.0, 0.0, 0.0))
    assert told[0] == pytest.approx(EAST, abs=0.1)

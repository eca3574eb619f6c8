"""Which of its scans a grid has drawn, on which storeys they lie, and which tiles a change may have altered."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_basestation.grid.scan_grid import CellRules, ScanGrid, ViewWeights
from kiteline_basestation.grid.tile_store import Place
from kiteline_core.geometry import sim3
from tests.basestation.flat_rooms import ROOM, camera, scan_of
from tests.basestation.grid.test_scan_grid import assert_equal
from tests.basestation.grid_scans import CONFIG, kept

SCAN = kept(scan_of(ROOM, 1.0, -1.0, 0.3))
STOREY_M = CONFIG.storey_m


@given(st.sets(st.integers(0, 13), max_size=12), st.randoms())
def test_when_the_newest_scans_of_a_view_leave_the_ones_before_are_drawn_again(left: set[int], random: object) -> None:
    grid, rest = ScanGrid(CONFIG), ScanGrid(CONFIG)
    poses = [camera(1.0 + 0.03 * k, -1.0, 0.3) for k in range(14)]
    for k, pose in enumerate(poses):
        grid.put(k, SCAN, pose)
    order = list(left)
    random.shuffle(order)  # type: ignore[attr-defined]
    for k in order:
        drawn = k in sorted(grid._placed)[-CONFIG.views :]
        assert grid.remove(k) == drawn
    for k in sorted({*range(14)} - left):
        rest.put(k, SCAN, poses[k])
    assert_equal(grid, rest)


def test_views_from_one_place_in_other_directions_are_all_drawn() -> None:
    grid = ScanGrid(CONFIG)
    for k in range(2 * CONFIG.views):
        grid.put(k, SCAN, camera(1.0, -1.0, 0.3 + (k % 2) * np.pi / 2))
    assert_equal(grid, grid.redrawn(CONFIG, ViewWeights(), CellRules()))


def test_the_main_storey_has_most_scans_and_what_lies_only_beside_it_is_separate() -> None:
    grid = ScanGrid(CONFIG)
    ramp = camera(1.0, 1.0, 0.0, 0.5 * STOREY_M)
    at = {k: camera(1.0, -1.0, 0.7 * k, (3 if k < 5 else 0) * STOREY_M) for k in range(10, 0, -1)}
    for k, pose in {**at, 11: ramp}.items():
        grid.put(k, SCAN, pose)
    assert grid.main_storey() == 0 and grid.separate_storeys() == [3]
    for k in (6, 7, 8, 9):
        grid.remove(k)
    assert grid.main_storey() == 3 and grid.separate_storeys() == [0, 1]
    for k in (1, 2, 3, 4):
        grid.remove(k)
    assert grid.main_storey() == 0 and grid.separate_storeys() == []
    assert grid.storey_of(CONFIG.ground_m + 1.6 * STOREY_M) == 2


def test_tiles_that_may_have_changed_are_those_drawn_on_since_and_those_around() -> None:
    grid, far_m = ScanGrid(CONFIG), 40.0
    grid.put(0, SCAN, camera(0.0, 0.0, 0.0))
    near = set(grid.places)
    begin = grid.revision
    grid.put(1, SCAN, camera(far_m, 0.0, 0.0))
    beside = grid.revision
    far = set(grid.places) - near
    around = {Place(p.storey, p.row + r, p.column + c) for p in far for r in (-1, 0, 1) for c in (-1, 0, 1)}
    assert set(grid.stale_since(begin)) == around
    grid.put(0, SCAN, camera(0.1, 0.0, 0.0))
    assert near <= set(grid.stale_since(beside)) and far.isdisjoint(grid.stale_since(beside))
    last = grid.revision
    assert set(grid.stale_since(last)) == set()
    assert grid.remove(1) and grid.revision == last + 1 and set(grid.stale_since(last)) == around
    assert not grid.remove(1) and grid.revision == last + 1


@pytest.mark.parametrize(("scale", "drawn"), [(0.9, True), (1.1, False)])
def test_a_scan_that_its_scale_makes_reach_beyond_a_hundred_metres_is_not_drawn(scale: float, drawn: bool) -> None:
    size = scale * 100.0 / SCAN.reach_m
    pose = camera(0.0, 0.0, 0.0, size * SCAN.height_m + CONFIG.ground_m)
    assert ScanGrid(CONFIG).put(0, SCAN, sim3.of(size, pose)) == drawn

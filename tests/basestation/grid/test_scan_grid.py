"""The grid from column scans: what it says of a room, that redrawing equals drawing from scratch, storeys, memory."""

import tracemalloc
from dataclasses import replace

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kiteline_basestation.grid import scan_kernels as kernels
from kiteline_basestation.grid.grid_view import GridViews, dense, grid_files
from kiteline_basestation.grid.kept_scan import keep
from kiteline_basestation.grid.scan_grid import ScanGrid, ViewWeights
from kiteline_core.arrays import F64, I64, U8, U16
from tests.basestation.flat_rooms import ROOM, box, camera, circle, scan_of
from tests.basestation.grid_scans import BF, CONFIG, at, drawn, flight, kept


def assert_equal(a: ScanGrid, b: ScanGrid) -> None:
    assert a.places == b.places
    for place in a.places:
        assert np.array_equal(a.log_odds(place), b.log_odds(place))
        assert np.array_equal(a.cells(place)[0], b.cells(place)[0])


def test_a_room_is_free_solid_at_walls_box_and_leg_and_unknown_outside() -> None:
    grid = drawn(flight())
    cells, corner, cell = dense(grid, 0)
    rows, columns = np.indices(cells.shape)
    x, y = corner[0] + (columns + 0.5) * cell, corner[1] + (rows + 0.5) * cell
    in_box = (x > -0.5) & (x < 0.4) & (y > -0.5) & (y < 0.6)
    near_leg = np.hypot(x - 2.02, y - 2.02) < 0.15
    near_box = (x > -0.6) & (x < 0.5) & (y > -0.6) & (y < 0.7)
    inside = (abs(x) < 3.85) & (abs(y) < 3.35) & ~near_box & ~near_leg
    assert np.mean(cells[inside] == 0) > 0.97
    assert not (cells[in_box] == 0).any()
    assert (cells[near_leg] > 0).any()
    assert not (cells[(abs(x) > 4.2) | (abs(y) > 3.7)] == 0).any()
    along = np.arange(-3.0, 3.0, 0.05)
    wall = np.stack([at(grid, along, np.full(len(along), 3.5 + d)) > 0 for d in (-0.06, -0.02, 0.02, 0.06)])
    assert wall.any(axis=0).mean() > 0.98, "walls are closed"


@settings(max_examples=10)
@given(st.integers(0, 2**31))
def test_any_order_of_drawing_moving_and_removing_equals_drawing_from_scratch(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scans = flight(12)
    grid = ScanGrid(replace(CONFIG, resident_tiles=4))
    for _ in range(30):
        k = int(rng.integers(12))
        if rng.random() < 0.2:
            grid.remove(k)
        else:
            x, y, heading = scans[k][1]
            grid.put(k, scans[k][0], camera(x + rng.normal(0, 2), y, heading + rng.normal(0, 0.5), rng.normal(0, 2)))
    final = {k: camera(x + 0.5 * rng.random(), y, heading) for k, (_, (x, y, heading)) in enumerate(scans) if k % 3}
    for k in range(12):
        if k in final:
            grid.put(k, scans[k][0], final[k])
        else:
            grid.remove(k)
    fresh = ScanGrid(CONFIG)
    for k in sorted(final, reverse=True):
        fresh.put(k, scans[k][0], final[k])
    assert_equal(grid, fresh)
    for k in final:
        grid.remove(k)
    assert not grid.places and not grid._store.pool.any()


def test_what_moves_less_than_the_lattice_is_not_drawn_again() -> None:
    scan, pose = flight(1)[0]
    grid = ScanGrid(CONFIG)
    assert grid.put(0, scan, camera(*pose))
    assert not grid.put(0, scan, camera(*pose))
    revision = grid.revision
    assert grid.put(0, scan, camera(pose[0] + 0.5, *pose[1:])) and grid.revision == revision + 1
    assert not grid.put(0, scan, camera(np.nan, 0.0, 0.0)) or len(grid) == 0


def test_a_vehicle_that_hovers_says_what_it_sees_a_few_times() -> None:
    """Log-odds of 16 bits would saturate, and what leaves later would stay for as long as it was seen."""
    rng = np.random.default_rng(5)
    scan, (x, y, heading) = flight(1)[0]
    poses = [camera(x + 0.2 * rng.random(), y + 0.2 * rng.random(), heading + 0.2 * rng.random()) for _ in range(300)]
    hovering = ScanGrid(CONFIG)
    for k, pose in enumerate(poses):
        hovering.put(k, scan, pose)
    views = len(hovering._views)
    assert len(hovering) == 300 and views <= 8
    most = max(int(np.abs(hovering.log_odds(place)).max()) for place in hovering.places)
    assert most <= views * CONFIG.views * ViewWeights().hit

    # Any order, with scans of other agents and after some moved away and back, gives the same.
    other = ScanGrid(CONFIG)
    for k in rng.permutation(300).tolist():
        other.put(k, scan, poses[k] if k % 7 else camera(-2.0, 0.0, 0.0))
    for k in range(0, 300, 7):
        other.put(k, scan, poses[k])
    assert_equal(hovering, other)
    for k in range(300):
        other.put((k, 1), scan, poses[k], source=1)
    assert max(int(np.abs(other.log_odds(place)).max()) for place in other.places) > most
    for k in range(300):
        other.remove((k, 1))
    assert_equal(hovering, other)

    # A wall that comes near is seen before it outvotes what was there.
    gone = kept(scan_of(np.array(box(-8.0, -8.0, 8.0, 8.0)), x, y, heading))
    for k in range(300, 330):
        hovering.put(k, gone, poses[k - 300])
    assert at(hovering, 2.0, 2.5) == 0


def test_storeys_lie_apart_and_a_ramp_joins_them() -> None:
    scans = flight(8)
    grid = ScanGrid(CONFIG)
    for k, (scan, pose) in enumerate(scans):
        grid.put(k, scan, camera(*pose, z=0.0))
        grid.put(100 + k, kept(scan_of(np.array(box(-2.0, -2.0, 2.0, 2.0)), 0.0, 0.0, k)), camera(0.0, 0.0, k, z=2.8))
    assert {p.storey for p in grid.places} == {0, 1}
    assert grid.main_storey() == 0 and grid.separate_storeys() == [1]
    assert GridViews(grid).take().others == 1
    alone = drawn(scans)
    for place in alone.places:
        assert np.array_equal(grid.log_odds(place), alone.log_odds(place))
    assert set(grid_files(grid)) == {"grid.pgm", "grid.yaml", "grid_storey+1.pgm", "grid_storey+1.yaml"}
    ramp = ScanGrid(CONFIG)
    ramp.put(0, scans[0][0], camera(*scans[0][1], z=1.3))
    assert {p.storey for p in ramp.places} == {0, 1}


def test_higher_storeys_lie_farther_apart() -> None:
    storeys = []
    for storey_m in (2.5, 10.0):
        grid = ScanGrid(replace(CONFIG, storey_m=storey_m))
        for z in (0.0, 2.8):
            grid.put(round(z), kept(scan_of(ROOM, 3.0, -2.0, 0.0)), camera(3.0, -2.0, 0.0, z=z))
        storeys.append({place.storey for place in grid.places})
    assert storeys == [{0, 1}, {0}]


def test_memory_goes_by_tiles_touched_and_a_far_outlier_costs_nothing() -> None:
    config = replace(CONFIG, resident_tiles=64)
    scan = kept(scan_of(np.array(box(-60.0, -60.0, 60.0, 60.0)), 0.0, 0.0, 0.0), config)
    grid = ScanGrid(config)
    tracemalloc.start()
    for k in range(60):
        grid.put(k, scan, camera(50.0 * k, 30.0 * k, 0.1 * k))
        if k == 19:  # from here on as many tiles are inflated as ever
            before, _ = tracemalloc.get_traced_memory()
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (used - before) / 40 < 50_000
    tiles = len(grid.places)
    grid.put(60, scan, camera(9e4, -9e4, 0.0))
    assert len(grid.places) < tiles * 1.1
    cells, _, cell = dense(grid, 0)
    assert cells.size <= 1 << 26 and cell > 0
    assert not grid.put(61, scan, camera(1e9, 0.0, 0.0)), "beyond all tiles"


def test_scans_beyond_all_storeys_or_of_a_huge_scale_are_not_drawn() -> None:
    grid, (scan, pose) = ScanGrid(CONFIG), flight(1)[0]
    grid.put(0, scan, camera(*pose))
    before = drawn(flight(1))
    high, huge = camera(*pose), camera(*pose)
    high[2, 3] = 1000.0
    huge[:3, :3] *= 1e6
    assert not grid.put(1, scan, high)
    assert not grid.put(2, scan, huge)
    assert_equal(grid, before)
    assert grid.put(0, scan, high)  # it moved there, and is taken out
    assert not len(grid)
    assert not grid.places


def test_an_obstacle_in_the_camera_itself_is_none() -> None:
    """No scan of ours has one; a faulty agent's may."""
    scan = scan_of(ROOM, 0.5, 0.5, 0.3)
    obstacle = scan.obstacle_m.copy()
    obstacle[10:13] = 0.0
    grid = ScanGrid(CONFIG)
    assert grid.put(0, kept(replace(scan, obstacle_m=obstacle)), camera(0.5, 0.5, 0.3))
    near = np.linspace(-0.3, 0.3, 13)
    assert not (at(grid, 0.5 + near, 0.5 + near) > 0).any()
    assert (dense(grid, 0)[0] > 0).sum() > 50, "walls beside it"


def test_ground_that_begins_beyond_the_range_needs_no_memory() -> None:
    pose = circle(1)[0]
    scan = scan_of(ROOM, *pose)
    n = len(scan)
    far = replace(
        scan, free_from_m=np.full(n, 250.0), free_m=np.full(n, 252.0), obstacle_m=np.full(n, np.inf),
        bands=np.zeros(n, np.uint8),
    )  # fmt: skip
    grid = ScanGrid(CONFIG)
    grid.put(0, kept(far), camera(*pose))
    assert grid.nbytes < 20e6


def test_a_scan_in_a_unit_of_its_submap_is_drawn_in_metres() -> None:
    pose = circle(1)[0]
    found = keep(CONFIG, scan_of(ROOM, *pose), BF, 3.0)
    assert found is not None
    S_w_c = camera(*pose)
    S_w_c[:3, :3] *= 3.0
    scaled = ScanGrid(CONFIG)
    scaled.put(0, found, S_w_c)
    plain = ScanGrid(CONFIG)
    plain.put(0, kept(scan_of(ROOM, *pose)), camera(*pose))
    assert_equal(scaled, plain)


def reference(x: float, y: float, first: float, step: float, ranges: F64, bands: U8, size: int) -> I64:
    """Cells (size, size) with the bands of obstacles, sampled densely on the surface in each column. ranges: (n,3)."""
    out = np.zeros((size, size), np.int64)
    for i, (lower, middle, upper) in enumerate(ranges):
        deep = abs(middle - lower) + abs(upper - middle)
        n = max(1, int(np.ceil(2.0 * (max(lower, middle, upper) * step + deep))))
        part = (np.arange(n) + 0.5) / n
        at = np.interp(part, [0.0, 0.5, 1.0], [lower, middle, upper])
        for a, r in zip(first + (i + part) * step, at, strict=True):
            out[int(np.floor(y + r * np.sin(a))), int(np.floor(x + r * np.cos(a)))] |= int(bands[i])
    return out


@given(st.integers(0, 2**31))
def test_hits_are_marked_as_in_the_reference_and_leave_no_trace(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(2, 80, (30, 1)) * (1.0 + rng.uniform(-0.1, 0.1, (30, 3)))
    bands = rng.integers(1, 8, 30).astype(np.uint8)
    weight = rng.integers(1, 9, 30)
    first, step = float(rng.uniform(-4, 4)), 0.03
    hits, cells = np.zeros((192, 192), np.uint16), np.zeros((4000, 2), np.int32)
    found = kernels.mark_hits(96.25, 95.5, first, step, ranges, bands, weight, hits, cells)
    assert np.array_equal(hits & 255, reference(96.25, 95.5, first, step, ranges, bands, 192))
    assert found == np.count_nonzero(hits)
    slots, pool = np.full((3, 3), -1, np.int32), np.zeros((9, 4, 64, 64), np.int16)
    touched, used = np.zeros((3, 3), np.uint8), np.zeros(1, np.int64)
    for sign in (1, -1):
        kernels.draw_hits(hits, cells, found, sign, slots, np.arange(9, dtype=np.int32), used, pool, touched)
        if sign == 1:
            whole = np.zeros((3, 192, 192), np.int64)
            for r, c in np.argwhere(slots >= 0):
                whole[:, r * 64 : r * 64 + 64, c * 64 : c * 64 + 64] = pool[slots[r, c]][1:]
            for b in range(3):
                assert np.array_equal(whole[b], np.where(hits >> b & 1, hits >> 8, 0))
    assert not pool.any()
    kernels.clear_hits(hits, cells, found)
    assert not hits.any()


def freed(
    x: float, y: float, first: float, step: float, columns: dict[str, F64], camera_band: int,
    weights: tuple[int, int, int, int], hits: U16,
) -> I64:  # fmt: skip
    """What `draw_free` takes from the planes (4,rows,columns): each cell asked for its column and its range."""
    rows, cells = np.indices(hits.shape)
    dx, dy = cells + 0.5 - x, rows + 0.5 - y
    distance, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
    n = len(columns["begin"])
    place = np.mod(angle - first, 2.0 * np.pi) / step
    i = np.minimum(place.astype(int), n - 1)
    end = columns["end"][i]
    left = np.cos(first + i * step) * dy - np.sin(first + i * step) * dx
    right = np.sin(first + (i + 1) * step) * dx - np.cos(first + (i + 1) * step) * dy
    part = left / (left + right)
    surface = np.where(
        part < 0.5, end[..., 0] + 2.0 * part * (end[..., 1] - end[..., 0]),
        end[..., 1] + (2.0 * part - 1.0) * (end[..., 2] - end[..., 1]),
    )  # fmt: skip
    least, most = np.maximum(end.min(-1), 0.0), np.maximum(end.max(-1), 0.0)
    begun = distance >= columns["begin"][i]
    whole = begun & ((distance <= least) | ((distance <= most) & (distance <= surface)))
    below = begun & ~whole & (distance <= columns["low"][i])
    bands = np.where(whole, 7, np.where(below, columns["under"][i].astype(int), 0))
    ground = bands > 0
    if camera_band >= 0:
        bands |= np.where(distance <= columns["clear"][i], 1 << camera_band, 0)
    bands = np.where(place < n, bands & ~hits.astype(int), 0)
    seen = columns["start"][i] <= distance
    sure = distance <= np.maximum(columns["sure"][i], columns["start"][i])
    fair = distance <= np.maximum(columns["fair"][i], columns["start"][i])
    value = np.where(fair & (seen | ~ground), np.where(sure, weights[1], weights[2]), weights[3])
    value = np.where(seen & (distance <= columns["near"][i]), weights[0], value)
    out = np.zeros((4, *hits.shape), np.int64)
    out[0] = np.where(bands == 7, value, 0)
    for b in range(3):
        out[1 + b] = np.where((bands != 7) & (bands >> b & 1 > 0), value, 0)
    return out


@given(st.integers(0, 2**31))
@example(40501)  # a column that is clear up to a negative range, and a cell nearer than that is long
def test_free_space_is_drawn_as_in_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, step, first = 20, float(rng.uniform(0.02, 0.12)), float(rng.uniform(-7.0, 7.0))
    (x, y), camera_band = rng.uniform(20.0, 170.0, 2).tolist(), int(rng.integers(-1, 3))
    ends = rng.uniform(-10.0, 90.0, (n, 1)) * (1.0 + rng.uniform(-0.1, 0.1, (n, 3)))
    ends[rng.random(n) < 0.2] = 0.0
    start = rng.uniform(0.0, 40.0, n)
    columns = {
        "begin": start * rng.uniform(0.6, 1.0, n), "start": start, "end": ends, "low": rng.uniform(0.0, 90.0, n),
        "under": rng.integers(0, 2, n).astype(np.uint8), "clear": rng.uniform(-1.0, 100.0, n),
        "sure": rng.uniform(0.0, 80.0, n), "near": rng.uniform(10.0, 60.0, n) * (rng.random(n) < 0.9),
    }  # fmt: skip
    columns["fair"] = columns["sure"] + rng.uniform(0.0, 20.0, n)
    hits = np.where(rng.random((192, 192)) < 0.02, rng.integers(1, 8, (192, 192)), 0).astype(np.uint16)
    slots, pool = np.full((3, 3), -1, np.int32), np.zeros((9, 4, 64, 64), np.int16)
    touched, used = np.zeros((3, 3), np.uint8), np.zeros(1, np.int64)
    kernels.draw_free(
        x, y, first, step, columns["begin"], columns["start"], ends, columns["low"], columns["under"],
        columns["clear"], camera_band, columns["near"], columns["sure"], columns["fair"], (4, 3, 2, 1),
        hits, 1, slots, np.arange(9, dtype=np.int32), used, pool, touched,
    )  # fmt: skip
    whole = np.zeros((4, 192, 192), np.int64)
    for r, c in np.argwhere(slots >= 0):
        whole[:, r * 64 : r * 64 + 64, c * 64 : c * 64 + 64] = pool[slots[r, c]]
    wanted = freed(x, y, first, step, columns, camera_band, (4, 3, 2, 1), hits)
    assert np.array_equal(-whole, wanted)
    assert np.array_equal(touched > 0, wanted.any(0).reshape(3, 64, 3, 64).any((1, 3)))


def test_a_surface_that_juts_out_within_a_column_has_no_gaps() -> None:
    """Its edges are equally far: the samples follow the way there and back."""
    hits, cells = np.zeros((192, 192), np.uint16), np.zeros((400, 2), np.int32)
    ranges, bands = np.array([[70.0, 80.0, 70.0]]), np.full(1, 7, np.uint8)
    found = kernels.mark_hits(20.0, 20.0, 0.7, 0.03, ranges, bands, np.full(1, 8), hits, cells)
    marked = cells[:found]
    for part in np.linspace(0.02, 0.98, 200):
        reach, angle = np.interp(part, [0.0, 0.5, 1.0], ranges[0]), 0.7 + part * 0.03
        place = np.floor([20.0 + reach * np.sin(angle), 20.0 + reach * np.cos(angle)])
        assert np.abs(marked - place).max(1).min() <= 1


@given(st.integers(0, 2**31), st.booleans())
def test_states_are_read_as_in_the_reference(seed: int, opening: bool) -> None:
    rng = np.random.default_rng(seed)
    pool = np.repeat(rng.integers(-5, 9, (4, 1, 16, 16)), 4, 1).repeat(4, 2).repeat(4, 3).astype(np.int16)
    pool[:, 2:] = 0
    pool[:, rng.integers(4)] += rng.integers(-1, 2, (4, 64, 64)).astype(np.int16)
    slots = np.array([[-1, 1, -1], [2, 0, -1], [-1, -1, 3]], np.int32)
    whole = np.zeros((3, 192, 192), np.int64)
    for r, c in np.argwhere(slots >= 0):
        whole[:, r * 64 : r * 64 + 64, c * 64 : c * 64 + 64] = pool[slots[r, c]][:1] + pool[slots[r, c]][1:]
    bands = int(rng.integers(1, 8))
    counted = [b for b in range(3) if bands >> b & 1]
    mask = sum((whole[b] >= 6).astype(int) << b for b in counted)
    whole = whole[counted]
    free = (whole <= -3).all(axis=0)
    square = [(r, c) for r in range(-2, 3) for c in range(-2, 3)]
    clear = ~np.any([np.roll((whole > 0).any(axis=0), s, (0, 1)) for s in square], axis=0)
    free |= clear & (whole <= -2).all(axis=0)
    shifts = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)]
    beside = np.any([np.roll(mask > 0, s, (0, 1)) for s in shifts], axis=0)
    free &= ~beside | (whole <= -4).all(axis=0)
    around = [s for s in shifts if s != (0, 0)]
    neighbours = np.sum([np.roll(free, s, (0, 1)) for s in around], axis=0)
    free |= (mask == 0) & (whole <= 0).all(axis=0) & ~beside & (neighbours >= 6)
    if opening:
        eroded = np.all([np.roll(free, s, (0, 1)) for s in shifts], axis=0)
        free &= np.any([np.roll(eroded, s, (0, 1)) for s in shifts], axis=0)
    expected = np.where(mask > 0, mask, np.where(free, 0, -1))[64:128, 64:128]
    cells = np.empty((64, 64), np.int8)
    known = kernels.read_states(slots, pool, bands, 6, 3, 2, 4, 6, int(opening), cells)
    assert np.array_equal(cells, expected)
    assert known == np.count_nonzero(expected >= 0)

"""Distances around the vehicle from its own scans and from tiles of the base's grid, in a room that is known."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_agent.config import LocalGridConfig
from kiteline_agent.runtime.controller import push_obstacles
from kiteline_agent.runtime.pose_schedule import PoseSchedule
from kiteline_agent.scans.local_grid import SECTORS, LocalGrid, Surroundings
from kiteline_agent.scans.range_error import RangeError
from kiteline_agent.scans.scan_stage import Scanned
from kiteline_codec.schema import GridTile
from kiteline_core.geometry import se3
from kiteline_core.geometry.disparity_offset import TERMS
from kiteline_core.ground.column_scan import ColumnScan, level_rotation

CELL_M = 0.1
WEST, EAST, SOUTH, NORTH = -2.0, 3.0, -1.5, 2.0  # walls of a room
BANDS_M = (0.1, 0.5, 1.2, 2.0)
REACH_M = LocalGridConfig().reach_m


def room(known_until_m: float = 20.0, mask: int = 7) -> dict[tuple[int, int], GridTile]:
    """Tiles in which cells beyond the walls are unknown, and those west of known_until_m too."""
    tiles = {}
    for column in range(-4, 5):
        for row in range(-4, 5):
            x = ((column * 64 + np.arange(64)) + 0.5)[None, :] * CELL_M
            y = ((row * 64 + np.arange(64)) + 0.5)[:, None] * CELL_M
            inside = (x > WEST) & (x < EAST) & (y > SOUTH) & (y < NORTH)
            wall = ~inside & (x > WEST - 0.2) & (x < EAST + 0.2) & (y > SOUTH - 0.2) & (y < NORTH + 0.2)
            cells = np.where(wall, mask, np.where(inside, 0, -1))
            tiles[column, row] = GridTile(
                column, row, 0, CELL_M, np.where(x > -known_until_m, cells, -1).astype(np.int8)
            )
    return tiles


def vehicle(x: float, y: float, heading_rad: float, tilt_rad: float = 0.0, z: float = 1.0) -> np.ndarray:
    """T_w_f: heading counter-clockwise from x of w."""
    upright = se3.so3_exp(np.array([0.0, 0.0, heading_rad])) @ np.diag([1.0, -1.0, -1.0])
    return se3.from_rt(upright @ se3.so3_exp(np.array([tilt_rad, 0.0, 0.0])), np.array([x, y, z]))


def around(tiles: dict[tuple[int, int], GridTile], T_w_f: np.ndarray) -> np.ndarray | None:
    """Distances by tiles alone."""
    found = LocalGrid(LocalGridConfig()).around(T_w_f, T_w_f, tiles, BANDS_M)
    return None if found is None else found.distance_m


def scan_at(x: float, y: float, heading_rad: float, z: float = 1.0, noise_m: float = 0.0, seed: int = 0) -> Scanned:
    """What a camera sees of the walls, over 80 degrees; o is w turned by half a radian."""
    n, step = 64, 1.4 / 64
    azimuth = (np.arange(n) - 31.5) * step
    angle = heading_rad + azimuth
    with np.errstate(divide="ignore"):
        to_x = np.where(np.cos(angle) > 0, (EAST - x) / np.cos(angle), (WEST - x) / np.cos(angle))
        to_y = np.where(np.sin(angle) > 0, (NORTH - y) / np.sin(angle), (SOUTH - y) / np.sin(angle))
    clear = np.minimum(to_x, to_y) + np.random.default_rng(seed).normal(0.0, noise_m, n)
    R_w_c = se3.so3_exp(np.array([0.0, 0.0, heading_rad])) @ np.array([[0, 0, 1.0], [-1.0, 0, 0], [0, -1.0, 0]])
    scan = ColumnScan(
        np.array([0.0, -1.0, 0.0]), azimuth[0], step, np.zeros(n), np.zeros(n), clear, np.full(n, 7, np.uint8), clear, z
    )
    return Scanned(scan, TURN @ se3.from_rt(R_w_c, np.array([x, y, z])), z, np.zeros(TERMS))


BF, EXACT = 50.0, RangeError.of_noise(50.0, 0.01)
TURN = se3.exp(np.array([4.0, -2.0, 0.3, 0.0, 0.0, 0.5]))


@given(
    x=st.floats(-1.5, 2.5), y=st.floats(-1.0, 1.5), quarter=st.integers(0, 3), tilt=st.floats(-0.4, 0.4),
)  # fmt: skip
def test_walls_of_a_room_lie_ahead_right_behind_and_left(x: float, y: float, quarter: int, tilt: float) -> None:
    distances = around(room(), vehicle(x, y, quarter * np.pi / 2, tilt))
    assert distances.shape == (SECTORS,)
    walls = [EAST - x, y - SOUTH, x - WEST, NORTH - y]  # clockwise from x of w
    for k in range(4):
        assert distances[k * SECTORS // 4] == pytest.approx(walls[(k - quarter) % 4] + CELL_M, abs=1.6 * CELL_M)
    assert np.isfinite(distances).all()


def test_own_scans_show_walls_wherever_the_odometry_frame_lies() -> None:
    grid = LocalGrid(LocalGridConfig())
    for k in range(12):
        grid.add(scan_at(0.1 * k, 0.0, 0.5 * k, noise_m=0.03, seed=k), EXACT)
    found = grid.around(TURN @ vehicle(0.5, 0.2, np.pi / 2), None, {}, BANDS_M)
    for k, wall in enumerate([NORTH - 0.2, EAST - 0.5, 0.2 - SOUTH, 0.5 - WEST]):
        assert found.distance_m[k * SECTORS // 4] == pytest.approx(wall, abs=0.1)
    assert found.nearest[0] == pytest.approx(0.2 - SOUTH, abs=0.1) and abs(found.nearest[1]) > 2.8
    assert "nearest obstacle: 1." in found.line


def test_what_was_not_seen_is_unknown_and_own_scans_count_before_tiles() -> None:
    grid = LocalGrid(LocalGridConfig())
    grid.add(scan_at(0.0, 0.0, 0.0), EXACT)
    T_w_f = vehicle(0.0, 0.0, 0.0)
    alone = grid.around(TURN @ T_w_f, None, {}, BANDS_M)
    assert np.isfinite(alone.distance_m[[0, 3, -3]]).all() and np.isnan(alone.distance_m[18:54]).all()
    nearer = {at: GridTile(*at, 0, CELL_M, np.full((64, 64), 7, np.int8)) for at in ((0, 0), (0, -1))}
    both = grid.around(TURN @ T_w_f, T_w_f, nearer, BANDS_M)
    assert both.distance_m[0] == pytest.approx(EAST, abs=0.1)  # seen clear since
    assert both.distance_m[18] < 0.5  # told by the base: not seen from here
    with_room = grid.around(TURN @ T_w_f, T_w_f, room(), BANDS_M)
    assert np.isfinite(with_room.distance_m).all()


def test_obstacles_far_above_or_below_do_not_count() -> None:
    grid = LocalGrid(LocalGridConfig())
    grid.add(scan_at(0.0, 0.0, 0.0, z=1.0), EXACT)
    for followed in (False, True):
        if followed:
            grid.follow(scan_at(0.0, 0.0, 0.0, z=2.5).T_o_c)
        higher = grid.around(TURN @ vehicle(0.0, 0.0, 0.0, z=2.5), None, {}, BANDS_M)
        assert np.isnan(higher.distance_m).all()
    low = room(mask=1)  # walls that reach 0.5 m above the ground
    over = grid.around(TURN @ vehicle(0.0, 0.0, 0.0, z=1.5), vehicle(0.0, 0.0, 0.0, z=1.5), low, BANDS_M)
    assert np.isnan(over.distance_m[SECTORS // 2])


def test_a_vehicle_that_flies_on_takes_its_scans_along() -> None:
    grid = LocalGrid(LocalGridConfig(scans=200))
    for k in range(100):
        grid.add(scan_at(-1.5 + 0.04 * k, 0.0, 0.0), EXACT)
    far = [scan_at(2.0, 0.0, 0.0)]
    for k in range(60):  # 30 m away, and back
        moved = se3.from_rt(np.eye(3), np.array([0.5 * k, 0.0, 0.0]))
        grid.add(replace(far[0], T_o_c=moved @ far[0].T_o_c), EXACT)
        assert grid.around(moved @ TURN @ vehicle(2.0, 0.0, 0.0), None, {}, BANDS_M) is not None
    for _ in range(60):  # frames, in which some scans each are drawn again
        grid.follow(far[0].T_o_c)
    back = grid.around(TURN @ vehicle(1.0, 0.0, 0.0), None, {}, BANDS_M)
    assert back.distance_m[0] == pytest.approx(2.0, abs=0.1)


def test_the_grid_and_its_tiles_take_less_than_four_mib() -> None:
    config = LocalGridConfig()
    grid = LocalGrid(config)
    held = [vars(grid), vars(grid._canvas), vars(grid._next)]
    arrays = [value for values in held for value in values.values() if isinstance(value, np.ndarray)]
    grid.add(scan_at(0.0, 0.0, 0.0), EXACT)
    scan, ranges = grid._scans[0].scan, grid._scans[0].ranges(EXACT, config.sigma_m)
    assert ranges[0] is grid._scans[0].ranges(EXACT, config.sigma_m)[0]  # kept
    each = (scan.free_from_m, scan.free_m, scan.obstacle_m, scan.bands, scan.clear_m, *ranges)
    scans = config.scans * sum(v.nbytes for v in each)
    assert sum(a.nbytes for a in arrays) + scans + config.tiles * (64 * 64 + 200) < 4 << 20


def test_own_scans_that_disagree_are_not_decided_by_the_base() -> None:
    """A single cell of the base's among those that own scans saw clear was an obstacle half a metre away."""
    grid, T_w_f = LocalGrid(LocalGridConfig()), vehicle(0.0, 0.0, 0.0)
    grid.add(scan_at(0.0, 0.0, 0.0), EXACT)
    ahead = grid._R_g_o @ ((TURN @ T_w_f)[:3, 3] + 0.5 * (TURN @ T_w_f)[:3, 0])
    j, i = ((ahead[:2] - grid._canvas.corner) / LocalGridConfig().cell_m).astype(int)
    assert grid._canvas.marks[i, j] > 0
    grid._canvas.cells[i - 3 : i + 4, j - 3 : j + 4] = 0
    told = {at: GridTile(*at, 0, CELL_M, np.full((64, 64), 7, np.int8)) for at in ((0, 0), (0, -1))}
    found = grid.around(TURN @ T_w_f, T_w_f, told, BANDS_M)
    assert found.distance_m[0] > 2.5


def test_tiles_tell_nothing_of_what_lies_above_their_bands() -> None:
    grid, T = LocalGrid(LocalGridConfig()), vehicle(0.0, 0.0, 0.0, z=3.0)
    grid.add(scan_at(0.0, 0.0, 0.0, z=3.0), EXACT)
    free = {(c, r): GridTile(c, r, 0, CELL_M, np.zeros((64, 64), np.int8)) for c in range(-5, 5) for r in range(-5, 5)}
    found = grid.around(TURN @ T, T, free, BANDS_M)
    assert np.isnan(found.distance_m[SECTORS // 2]) and np.isfinite(found.distance_m[0])


def test_tiles_tell_nothing_while_own_scans_do_not_know_the_ground() -> None:
    """A low box would be told to a vehicle that flies above it."""
    grid, T = LocalGrid(LocalGridConfig()), vehicle(0.0, 0.0, 0.0)
    low = {(c, r): GridTile(c, r, 0, CELL_M, np.ones((64, 64), np.int8)) for c in range(-5, 5) for r in range(-5, 5)}
    assert around(low, T)[SECTORS // 2] < 0.5, "without scans all bands are told"
    grid.add(replace(scan_at(0.0, 0.0, 0.0), height_m=None), EXACT)
    found = grid.around(TURN @ T, T, low, BANDS_M)
    assert np.isnan(found.distance_m[SECTORS // 2]) and np.isfinite(found.distance_m[0])


def test_a_vertical_that_is_known_late_levels_earlier_scans() -> None:
    """A flight that begins in motion: tilted axes would let a level flight climb out of what it saw."""
    grid, tilt = LocalGrid(LocalGridConfig()), se3.so3_exp(np.array([0.04, 0.0, 0.03]))
    for k in range(40):
        scanned = scan_at(-1.5 + 0.1 * k, 0.0, 0.0)
        if k < 3:
            wrong = replace(scanned.scan, up_c=tilt @ scanned.scan.up_c)
            scanned = replace(scanned, scan=wrong)
        grid.add(scanned, EXACT)
    heights = [drawn.z_m for drawn in grid._scans]
    assert len(heights) == 40 and np.ptp(heights) < 0.01
    level = LocalGrid(LocalGridConfig())
    for k in range(40):
        level.add(scan_at(-1.5 + 0.1 * k, 0.0, 0.0), EXACT)
    T = TURN @ vehicle(2.4, 0.0, 0.0)
    for _ in range(10):
        grid.follow(scan_at(2.4, 0.0, 0.0).T_o_c)
    found, expected = (g.around(T, None, {}, BANDS_M) for g in (grid, level))
    assert np.isnan(found.distance_m).mean() < np.isnan(expected.distance_m).mean() + 0.05
    both = np.isfinite(found.distance_m) & np.isfinite(expected.distance_m)
    assert np.abs(found.distance_m - expected.distance_m)[both].max() < 0.15


def test_scans_of_a_vertical_that_was_far_off_are_left_out() -> None:
    """They took floor or ceiling for what stands at their height. Later ones of the same view are kept as before."""
    grid, tilt = LocalGrid(LocalGridConfig()), se3.so3_exp(np.array([0.15, 0.0, 0.1]))
    for k in range(3):
        scanned = scan_at(0.05 * k, 0.0, 0.0)
        near = replace(scanned.scan, up_c=tilt @ scanned.scan.up_c, clear_m=np.full(len(scanned.scan), 0.6))
        grid.add(replace(scanned, scan=near, repeats=k > 0), EXACT)
    for k in range(8):
        grid.add(replace(scan_at(0.1, 0.0, 0.0), repeats=k > 0), EXACT)
    assert len(grid._scans) == 1 + LocalGridConfig().repeats
    found = grid.around(TURN @ vehicle(0.1, 0.0, 0.0), None, {}, BANDS_M)
    assert found.distance_m[0] == pytest.approx(EAST - 0.1, abs=0.1)


def test_what_was_clear_at_another_height_is_not_free_here() -> None:
    """A drone that descends saw over what stands before it."""
    grid, config = LocalGrid(LocalGridConfig()), LocalGridConfig()
    grid.add(scan_at(0.0, 0.0, 0.0, z=1.0), EXACT)
    for z, told in ((1.0, True), (1.0 - 0.9 * config.slab_m, True), (0.7, False)):
        grid.follow(scan_at(0.0, 0.0, 0.0, z=z).T_o_c)
        found = grid.around(TURN @ vehicle(0.0, 0.0, 0.0, z=z), None, {}, BANDS_M)
        assert bool(np.isfinite(found.distance_m[0])) == told


@given(
    clear=st.floats(0.6, 9.0), c0=st.floats(-0.9, 0.9), cx=st.floats(-0.3, 0.3), pitch=st.floats(-0.5, 0.5),
    roll=st.floats(-0.3, 0.3),
)  # fmt: skip
def test_ranges_are_corrected_by_the_offset_that_is_found_later(
    clear: float, c0: float, cx: float, pitch: float, roll: float
) -> None:
    """Against pixels: where each column's point lies in the image, and what its disparity is there."""
    up_c = se3.so3_exp(np.array([pitch, 0.0, roll])) @ np.array([0.0, -1.0, 0.0])
    scan = replace(scan_at(0.0, 0.0, 0.0).scan, up_c=up_c, clear_m=np.full(64, clear))
    offset = np.array([c0, cx, 0.0, 0.0, 0.0])
    cov = np.diag([0.04, 0.01, 0.0, 0.0, 0.0])
    ranges, certain = RangeError(BF, 0.2, offset, cov).ranges(scan, np.zeros(TERMS), 0.07)
    R_c_l = level_rotation(up_c)
    for azimuth, found, sure in zip(scan.azimuths_rad, ranges, certain, strict=True):
        x, _, depth = R_c_l @ np.array([clear * np.cos(azimuth), clear * np.sin(azimuth), 0.0])
        wrong_by = c0 + cx * x / depth
        true_depth = BF / (BF / depth - wrong_by) if BF / depth > wrong_by else np.inf
        assert found == pytest.approx(clear * true_depth / depth, rel=1e-9)
        sigma_px = np.sqrt(0.2**2 + 0.04 + 0.01 * (x / depth) ** 2)
        assert sigma_px * (depth / clear) * sure**2 / BF == pytest.approx(0.07)
    assert not RangeError.of_noise(BF, 0.2).ranges(replace(scan, clear_m=np.zeros(64)), offset, 0.07)[0].any()


def test_scans_are_drawn_anew_once_the_rig_is_found_to_be_worn_and_only_near_ones_are_told_before() -> None:
    grid, T = LocalGrid(LocalGridConfig()), TURN @ vehicle(0.0, 0.0, 0.0)
    worn = np.array([0.4, 0.0, 0.0, 0.0, 0.0])
    scan = scan_at(0.0, 0.0, 0.0)
    true_m = scan.scan.clear_m
    ahead = np.cos(scan.scan.azimuths_rad)  # of depth in a range
    measured_m = BF / (BF / true_m + worn[0] * ahead)
    scan = replace(scan, scan=replace(scan.scan, clear_m=measured_m))
    doubtful = RangeError(BF, 0.2, np.zeros(TERMS), np.diag([0.5, 0, 0, 0, 0]))
    grid.add(scan, doubtful)
    before = grid.around(T, None, {}, BANDS_M)
    assert np.isnan(before.distance_m[0]), "3 m away: unknown rather than wrong"
    grid.add(scan, RangeError(BF, 0.05, worn, np.zeros((TERMS, TERMS))))
    after = grid.around(T, None, {}, BANDS_M)
    assert after.distance_m[0] == pytest.approx(EAST, abs=0.08)
    w = vehicle(0.0, 0.0, 0.0)
    with_tiles = grid.around(T, w, room(), BANDS_M)
    assert np.isnan(with_tiles.distance_m[36]), "tiles were drawn by what was wrong"
    for _ in range(LocalGridConfig().scans):
        grid.add(scan, RangeError(BF, 0.05, worn, np.zeros((TERMS, TERMS))))
    later = grid.around(T, w, room(), BANDS_M)
    assert np.isfinite(later.distance_m).all()
    near = LocalGrid(LocalGridConfig())
    near.add(scan_at(EAST - 1.5, 0.0, 0.0), doubtful)
    seen = near.around(TURN @ vehicle(EAST - 1.5, 0.0, 0.0), None, {}, BANDS_M)
    assert seen.distance_m[0] == pytest.approx(1.5, abs=0.1), "near ones never vanish"


def test_what_is_not_known_is_not_free() -> None:
    distances = around(room(known_until_m=1.0), vehicle(0.0, 0.0, 0.0))
    assert np.isnan(distances[SECTORS // 2]) and distances[0] == pytest.approx(EAST + CELL_M, abs=0.15)
    free = {(c, r): GridTile(c, r, 0, CELL_M, np.zeros((64, 64), np.int8)) for c in range(-5, 5) for r in range(-5, 5)}
    far = around(free, vehicle(0.0, 0.0, 0.7))
    assert far is not None and np.isinf(far).all()
    free[0, 0].cells[5, 20] = 4  # one cell, 2.1 m away
    near = around(free, vehicle(0.0, 0.0, np.arctan2(5.5, 20.5)))
    assert near[0] == pytest.approx(2.12, abs=0.1) and near.min() <= near[0] < REACH_M


def test_without_a_grid_or_a_heading_nothing_is_told() -> None:
    assert around({}, vehicle(0.0, 0.0, 0.0)) is None
    nose_up = vehicle(0.0, 0.0, 0.0) @ se3.from_rt(se3.so3_exp(np.array([0.0, np.pi / 2, 0.0])), np.zeros(3))
    assert around(room(), nose_up) is None


@pytest.mark.parametrize("cell_m", [1e-4, 25.0, 100.0])
def test_any_size_of_cells_costs_little(cell_m: float) -> None:
    """A tile is a record from the link."""
    tiles = {(0, 0): GridTile(0, 0, 0, cell_m, np.full((64, 64), 3, np.int8))}
    distances = around(tiles, vehicle(0.5, 0.5, 0.0))
    assert distances.shape == (SECTORS,)


def test_asking_does_not_change_what_is_told_later() -> None:
    """A replay asks for less than a flight with a controller: the log's lines must be equal."""
    rng = np.random.default_rng(3)
    asked, plain = LocalGrid(LocalGridConfig(scans=6)), LocalGrid(LocalGridConfig(scans=6))
    for k in range(40):
        x, turn = -1.0 + 0.08 * k, 0.3 * k
        for grid in (asked, plain):
            grid.add(scan_at(x, 0.1, turn, noise_m=0.05, seed=k), EXACT)
            grid.follow(scan_at(x, 0.1, turn).T_o_c)
        away = TURN @ vehicle(float(rng.uniform(-6.0, 6.0)), 0.0, turn, z=float(rng.uniform(0.0, 3.0)))
        asked.around(away, None, {}, BANDS_M)
        found = [grid.around(TURN @ vehicle(x, 0.1, turn), None, {}, BANDS_M) for grid in (asked, plain)]
        assert found[0] is not None and found[1] is not None
        assert np.array_equal(found[0].distance_m, found[1].distance_m, equal_nan=True)


def test_who_walks_into_a_view_that_stays_is_told_and_other_views_are_kept() -> None:
    grid, distances = LocalGrid(LocalGridConfig()), []
    for k in range(40):
        grid.add(scan_at(0.0, 0.0, 2.0 * np.pi * k / 40), EXACT)
    seen = scan_at(0.0, 0.0, 0.0)
    person = replace(seen.scan, clear_m=np.full_like(seen.scan.clear_m, 1.2))
    for shown in (0, 12, 60):
        for _ in range(shown):
            grid.add(replace(seen, scan=person, repeats=True), EXACT)
        found = grid.around(TURN @ vehicle(0.0, 0.0, 0.0), None, {}, BANDS_M)
        distances.append(found.distance_m)
    assert distances[0][0] == pytest.approx(EAST, abs=0.1)
    assert distances[1][0] == pytest.approx(1.2, abs=0.1) and distances[2][0] == pytest.approx(1.2, abs=0.1)
    for told in distances:
        assert told[SECTORS // 2] == pytest.approx(-WEST, abs=0.1)  # behind: not in view any more


@pytest.mark.parametrize(
    ("turn_deg", "where"), [(0.0, "ahead"), (5.0, "5 degrees right"), (-90.0, "90 degrees left"), (180.0, "behind")]
)
def test_the_log_says_where_the_nearest_obstacle_is(turn_deg: float, where: str) -> None:
    distances = np.full(SECTORS, np.nan)
    distances[round(turn_deg / 5.0) % SECTORS] = 1.25
    assert Surroundings(distances, REACH_M).line == f"nearest obstacle: 1.25 m {where}, 99 % unknown"


class Heard:
    """Stands for the flight controller's link."""

    T_b_f = np.eye(4)

    def __init__(self) -> None:
        self.sent: list[list[float]] = []

    def push_obstacles(self, distance_m: list[float], reach_m: float, now_ns: int) -> None:
        self.sent.append(distance_m)


def test_only_a_vehicle_that_is_tracked_tells_its_obstacles() -> None:
    told: Surroundings | None = Surroundings(np.full(SECTORS, 2.0), REACH_M)
    heard = Heard()

    def push(*, tracked: bool, known: bool) -> int:
        agent = SimpleNamespace(surroundings=lambda pose, T_b_f: told if known else None)
        pose = SimpleNamespace(tracked=tracked)
        for estimate, predicted in ((pose, None), (None, pose), (None, None)):
            output, due = SimpleNamespace(estimate=estimate, predicted=predicted), PoseSchedule(10.0, 0)
            for now_ns in (5, 6):  # due once
                push_obstacles(cast(Any, heard), cast(Any, agent), cast(Any, output), due, now_ns)
        return len(heard.sent)

    assert push(tracked=False, known=True) == 0
    assert push(tracked=True, known=False) == 0
    assert push(tracked=True, known=True) == 2  # of a frame, and predicted
    assert heard.sent[0][0] == 2.0


def test_a_tile_that_replaces_another_is_seen_at_once() -> None:
    grid, T = LocalGrid(LocalGridConfig()), vehicle(3.2, 3.2, 0.0)
    for state in (0, 7) * 4:  # a new record often lies where the one before lay in memory
        cells = np.full((64, 64), state, np.int8)
        tiles = {(0, 0): GridTile(0, 0, 0, CELL_M, cells)}
        found = grid.around(T, T, tiles, BANDS_M)
        assert bool(np.isfinite(found.distance_m).all()) == (state > 0)
        del tiles

"""What the grid's benchmark judges with: reference methods on scenes whose answer is known, and objects in a grid."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.kept_scan import keep
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_bench.grid import costs, maps, obstacles, robust, scans, street
from kiteline_bench.grid.accuracy import judged, objects_present
from kiteline_bench.grid.flown import FlownGrid
from kiteline_bench.grid.ideal import by_centres, by_whole_cells
from kiteline_bench.grid.places import Place
from kiteline_bench.grid.ray_kernels import cast_rays
from kiteline_bench.grid.sparse import (
    GROUND,
    OBSTACLE,
    UNLABELLED,
    SparsePoints,
    binary_grid,
    labels_by_height,
    log_odds_grid,
)
from kiteline_codec.channel import plain_pair
from kiteline_codec.schema import CulledLandmarks, GridTile, KeyframeScan, messages
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_core.ids import KeyframeId
from kiteline_hw.sim.source import open_sim
from kiteline_hw.sim.truth.box_files import read_boxes
from kiteline_hw.sim.truth.occupancy import occupancy
from kiteline_hw.sim.truth.sight import look
from kiteline_hw.sim.world.world import World
from kiteline_lab.grids.files import FREE, OCCUPIED, UNKNOWN, GridFile


def room() -> SparsePoints:
    """A floor of 6 by 6 m with a wall at x = 3, seen from a ring of cameras 1.2 m above it."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-3, 3, (1500, 2)), rng.normal(0, 0.01, 1500)])
    wall = np.column_stack([np.full(600, 3.0), rng.uniform(-3, 3, 600), rng.uniform(0.2, 2.5, 600)])
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    cameras = np.column_stack([1.5 * np.cos(angle), 1.5 * np.sin(angle), np.full(12, 1.2)])
    points = np.concatenate([floor, wall])
    pairs = np.array([(i, j) for i in range(12) for j in range(i % 4, len(points), 4)], np.int64)
    return SparsePoints(cameras, points, pairs)


def state_at(grid: GridFile, x: float, y: float) -> int:
    c, r = np.floor(grid.cells(np.array([[x, y]]))[0]).astype(int)
    return int(grid.state[r, c])


@pytest.mark.parametrize("method", ["log_odds", "binary"])
def test_references_see_floor_and_wall(method: str) -> None:
    sparse = room()
    labels, ground = labels_by_height(sparse)
    assert np.abs(ground[:1500]).max() < 0.05
    assert (labels[:1500] == GROUND).all() and (labels[1500:][sparse.points[1500:, 2] < 1.9] == OBSTACLE).all()
    assert (labels[1500:][sparse.points[1500:, 2] > 2.1] == UNLABELLED).all()
    grid = log_odds_grid(sparse, 0.1) if method == "log_odds" else binary_grid(sparse, labels, 0.1)
    inside = [state_at(grid, x, y) for x in np.arange(-2.0, 2.1, 0.5) for y in np.arange(-2.0, 2.1, 0.5)]
    assert np.mean(np.array(inside) == FREE) > 0.9
    assert np.mean([state_at(grid, 3.02, y) == OCCUPIED for y in np.arange(-2.5, 2.5, 0.1)]) > 0.8
    assert not (grid.state[:, grid.state.shape[1] - 1] == FREE).any()


def test_overlong_rays_free_nothing() -> None:
    sparse = room()
    far = SparsePoints(
        sparse.cameras, np.concatenate([sparse.points, [[-15.0, 0.0, 0.0]]]),
        np.concatenate([sparse.pairs, [[6, len(sparse.points)]]]),
    )  # fmt: skip
    labels = np.append(labels_by_height(sparse)[0], GROUND).astype(np.uint8)
    assert binary_grid(far, labels, 0.1).origin[0] > -4.0
    near = replace(far, points=np.concatenate([sparse.points, [[-2.9, 0.0, 0.0]]]))
    assert binary_grid(near, labels, 0.1).origin[0] > -4.0


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_rays_as_counted_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, end = rng.integers(0, 20, (6, 2)), rng.integers(0, 20, (6, 2))
    z, ceiling, short = rng.uniform(0, 2, (6, 2)), rng.uniform(0.5, 2.5, 6), rng.integers(0, 2, 6)
    low = np.where(rng.random((20, 20)) < 0.3, 0.5, np.inf)
    high = np.where(np.isfinite(low), 1.2, -np.inf)
    free, through, expected_free, expected_through = (np.zeros((20, 20), np.int64) for _ in range(4))
    cast_rays(start, end, z, ceiling, short, 0.1, low, high, free, through)
    for (c, r), (c1, r1), (za, zb), top, left in zip(start, end, z, ceiling, short, strict=True):
        steps, error = max(abs(c1 - c), abs(r1 - r)), abs(c1 - c) - abs(r1 - r)
        dc, dr = abs(c1 - c), abs(r1 - r)
        for k in range(steps + 1 - left):
            height = za + (zb - za) / max(steps, 1) * k
            expected_free[r, c] += height < top
            expected_through[r, c] += low[r, c] - 0.1 < height < high[r, c] + 0.1
            twice = 2 * error
            if twice > -dr:
                error -= dr
                c += 1 if c1 > c else -1
            if twice < dc:
                error += dc
                r += 1 if r1 > r else -1
    assert np.array_equal(free, expected_free) and np.array_equal(through, expected_through)


def test_objects_are_present_or_missed() -> None:
    world = open_sim("room?objects=1", seed=1, texture_bits=7, scale=0.1).world
    true = occupancy(world, 0.1, 2.0)
    states = np.full(true.image.shape, FREE, np.int8)
    states[true.image == 0] = OCCUPIED
    grid = GridFile(true.cell_m, (*true.corner, 0.0), states)
    place = Place("room", "", grid, grid, grid, world)
    bars = objects_present(place, grid, np.eye(3))
    assert len(bars) == 5 and all(bar.met for bar in bars)
    empty = replace(grid, state=np.full(states.shape, FREE, np.int8))
    assert not any(bar.met for bar in objects_present(place, empty, np.eye(3)))
    unseen = Place("room", "", grid, replace(grid, state=np.full(states.shape, UNKNOWN, np.int8)), grid, world)
    assert objects_present(unseen, grid, np.eye(3)) == []


def test_a_loop_that_leaves_traces_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    config, rng = GridConfig(), np.random.default_rng(0)
    kept = keep(config, maps.road_scan(rng), 175.0)
    assert kept is not None
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    scans = [(kept, se3.from_rt(level, np.array([0.5 * k, 0.0, 0.6]))) for k in range(6)]
    (bar,) = maps._after_a_loop(config, scans)
    assert bar.met and "0 changed" not in bar.measured
    put = ScanGrid.put
    monkeypatch.setattr(ScanGrid, "put", lambda grid, k, scan, pose: k not in grid and put(grid, k, scan, pose))
    (bar,) = maps._after_a_loop(config, scans)
    assert not bar.met, "keyframes that stay where they were drawn first"


def test_half_of_a_disparity_image_goes_missing_in_blocks() -> None:
    disparity = np.random.default_rng(1).uniform(1, 40, (120, 376)).astype(np.float32)
    damaged = robust._without_half(3)(disparity)
    assert 0.35 < (damaged == 0).mean() < 0.65
    assert np.array_equal(damaged[damaged > 0], disparity[damaged > 0])
    assert np.array_equal(damaged, robust._without_half(3)(disparity))
    other = robust._without_half(4)(disparity)
    assert 0.15 < ((damaged == 0) & (other == 0)).mean() < 0.35, "each draw misses other blocks"


def test_poses_that_face_walls_stand_before_them() -> None:
    source = open_sim("room", seed=2, texture_bits=7, scale=0.1, seconds=2.0)
    assert source.world.shell is not None
    shell = source.world.boxes[source.world.shell]
    for pose in robust._at_walls(source):
        T_w_c = pose @ source.rig.T_b_c
        gap = shell[3:5] - np.abs(T_w_c[:2, 3] - shell[:2])
        axis = int(np.argmin(gap))
        assert 0.45 < gap[axis] < 0.95 and gap[1 - axis] > 1.0
        ahead = T_w_c[:3, 2]
        assert ahead[axis] * np.sign(T_w_c[axis, 3] - shell[axis]) > 0.999, "it looks at the near wall"
        assert T_w_c[2, 1] < -0.999, "level"


def test_free_cells_inside_a_box_and_out_of_sight_are_told(tmp_path: Path) -> None:
    (tmp_path / "b.csv").write_text("0,0,1.5,4,3,1.5,0\n1,0,0.5,0.5,0.5,0.5,0\n")
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    camera = CameraModel(160, 120, 80.0, 80.0, 79.5, 59.5, Lens.NONE, ())
    seen = look(read_boxes(tmp_path / "b.csv"), camera, se3.from_rt(level, np.array([-2.0, 0.0, 0.8]))[None])

    class Case(robust._Case):
        def grid(self) -> GridFile:
            return GridFile(0.05, (-0.5, -0.5, 0.0), np.full((20, 60), FREE, np.int8))  # x to 2.5, y from -.5 to .5

    case = Case([], seen, 1.0)
    assert [bar.measured for bar in robust._bars("case", case, case)] == [
        b.measured for b in robust._bars("case", case)
    ]
    wrong, unseen = robust._bars("case", case)
    assert not wrong.met and float(wrong.measured.split()[0]) == pytest.approx(100 / 3, abs=3)
    assert not unseen.met and float(unseen.measured.split()[0]) == pytest.approx(100 / 3, abs=3)


def posed(x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    """A vehicle (forward, right, down) at a height of 1 m."""
    turn = se3.so3_exp(np.array([0.0, 0.0, yaw])) @ np.diag([1.0, -1.0, -1.0])
    return se3.from_rt(turn, np.array([x, y, 1.0]))


BANDS_M = (0.1, 0.5, 1.2, 2.0)


def box_room(tmp_path: Path) -> World:
    """8 by 6 m with a pillar ahead, and a low box to the right of the middle."""
    (tmp_path / "b.csv").write_text("0,0,1.5,4,3,1.5,0\n2.1,0,1.5,0.1,0.5,1.5,0\n0,-1.5,0.2,0.3,0.3,0.2,0\n")
    return read_boxes(tmp_path / "b.csv")


def test_true_distances_go_clockwise_and_know_heights(tmp_path: Path) -> None:
    near, far = obstacles.true_distances(box_room(tmp_path), posed(0.0, 0.0), 72, BANDS_M)
    assert near[0] == pytest.approx(2.0, abs=0.01) and far[0] == pytest.approx(2.0, abs=0.01)
    assert far[18] == pytest.approx(3.0, abs=0.01), "to the right, over the low box"
    assert near[18] == pytest.approx(3.0, abs=0.01), "which lies below the bands that the vehicle is in"
    assert far[36] == pytest.approx(4.0, abs=0.01) and (near <= far + 1e-9).all()
    turned, _ = obstacles.true_distances(box_room(tmp_path), posed(0.0, 0.0, 0.5 * np.pi), 72, BANDS_M)
    assert np.allclose(turned[18], near[0]) and np.allclose(turned[0], 3.0, atol=0.01)


def test_the_judge_counts_right_wrong_unknown_and_phantoms(tmp_path: Path) -> None:
    world = box_room(tmp_path)
    judge = obstacles.Judge(world, BANDS_M)
    _, far = obstacles.true_distances(world, posed(0.0, 0.0), 72, BANDS_M)
    only_ahead = np.where(np.abs((np.arange(72) + 36) % 72 - 36) <= 8, far, np.nan)
    judge.compare(only_ahead, posed(0.0, 0.0), 0.05, 10.0)
    assert (judge.told, judge.right, judge.unknown, judge.unseen) == (17, 17, 55, 0)
    phantom = only_ahead.copy()
    phantom[3] = 0.4
    for _ in range(4):
        judge.compare(phantom, posed(0.0, 0.0), 0.05, 10.0)
    assert judge.phantom_s == pytest.approx(0.3) and judge.told - judge.right == 4
    judge.compare(far, posed(0.0, 0.0), 0.05, 10.0)
    assert judge.unseen == 72 - 23, "the vehicle has not turned yet"
    judge.compare(only_ahead + 0.3, posed(0.0, 0.0), 0.05, 10.0)
    assert judge.told - judge.right > 4 + 12


def test_nothing_within_reach_is_right_where_the_wall_lies_beyond(tmp_path: Path) -> None:
    judge = obstacles.Judge(box_room(tmp_path), BANDS_M)
    judge.compare(np.full(72, np.inf), posed(0.0, 0.0), 0.05, 1.5)
    assert judge.right == judge.told == 72
    judge.compare(np.full(72, np.inf), posed(0.0, 0.0), 0.05, 3.5)
    assert judge.right - 72 == np.sum(obstacles.true_distances(judge.world, posed(0.0, 0.0), 72, BANDS_M)[1] > 3.4) > 0


def test_the_way_that_was_driven_is_looked_up_in_the_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    states = np.full((100, 200), UNKNOWN, np.int8)
    states[40:60, :150] = FREE
    states[20, :] = OCCUPIED
    path = np.column_stack([np.linspace(0.5, 9.5, 30), np.full(30, 2.5)])
    monkeypatch.setattr(street, "_path", lambda _: path)
    flight = FlownGrid(None, GridFile(0.05, (0.0, 0.0, 0.0), states), np.eye(4), 0.0)  # type: ignore[arg-type]
    free, known, solid = street._driven(flight)
    assert free == 1.0 and 0.4 < known < 0.6 and solid == pytest.approx(200 * 0.05**2)
    picture = cv2.imdecode(np.frombuffer(street._picture(flight, np.zeros((37, 124), np.uint8)), np.uint8), 1)
    assert picture.shape[1] == 900 and ((picture[..., 2] > 180) & (picture[..., 0] < 90)).sum() > 100


def test_only_scans_and_tiles_are_counted() -> None:
    ours, theirs = plain_pair()
    scans: list[int] = []
    tiles: list[int] = []
    counted = costs.ReceivedBytes(ours, scans, tiles)
    scan = KeyframeScan(KeyframeId(5), maps.road_scan(np.random.default_rng(0)), np.zeros(3, np.uint8))
    tile = GridTile(1, 2, 0, 0.05, np.zeros((64, 64), np.int8))
    other = CulledLandmarks(KeyframeId(7), np.zeros(0, np.uint16), 1)
    for record in (scan, tile, other):
        theirs.put(record)
    assert len(counted.receive([], 0)) == 3
    assert scans == [len(messages.encode(scan))] and tiles == [len(messages.encode(tile))]
    assert counted.profile is ours.profile


def test_a_pose_that_is_not_finite_does_not_move_the_storey() -> None:
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    scan = maps.road_scan(np.random.default_rng(0))
    good = scans.PosedScan(scan, se3.from_rt(level, np.array([0.0, 0.0, 4.6])))
    bad = scans.PosedScan(scan, np.full((4, 4), np.nan))
    assert scans.grid_config([good, bad]).ground_m == pytest.approx(3.0)
    assert np.array_equal(
        scans.as_file(scans.drawn([good, bad], 175.0)).state, scans.as_file(scans.drawn([good], 175.0)).state
    )


def test_what_is_free_beyond_the_range_is_no_error_if_it_was_in_sight_and_recall_does_not_ask_for_it() -> None:
    """A strip of 10 m of which the first 6 m count, 8 m were in sight, and the last metre is a wall."""

    def strip(free_m: float, wall: bool = False) -> GridFile:
        state = np.full((20, 200), UNKNOWN, np.int8)
        state[:, : round(free_m / 0.05)] = FREE
        if wall:
            state[:, 180:] = OCCUPIED
        return GridFile(0.05, (0.0, 0.0, 0.0), state)

    place = Place("strip", "", strip(9.0, wall=True), strip(6.0), strip(8.0), None)
    precision, recall = {}, {}
    for free_m in (5.0, 6.0, 8.0, 10.0):
        found = judged(place, strip(free_m), np.eye(3))[0]
        precision[free_m], recall[free_m] = found.precision, found.recall
    assert precision[5.0] == precision[6.0] == precision[8.0] == 100.0 > precision[10.0]
    assert recall[5.0] < 90.0 < recall[6.0] == recall[8.0] == recall[10.0] == 100.0


def test_the_truth_on_turned_cells_frees_fewer_of_them_as_a_whole() -> None:
    state = np.full((80, 80), FREE, np.int8)
    state[:, 60:] = OCCUPIED
    true = GridFile(0.05, (0.0, 0.0, 0.0), state)
    cells = GridFile(0.05, (0.0, 0.0, 0.0), np.full((90, 90), UNKNOWN, np.int8))
    turn = np.array([[np.cos(0.3), -np.sin(0.3), 0.4], [np.sin(0.3), np.cos(0.3), -0.3], [0.0, 0.0, 1.0]])
    centres, whole = (draw(true, cells, turn).state for draw in (by_centres, by_whole_cells))
    r, c = np.indices((90, 90))
    x = 0.05 * (np.cos(0.3) * (c + 0.5) - np.sin(0.3) * (r + 0.5)) + 0.4
    known = centres != UNKNOWN
    assert np.array_equal(centres[known] == OCCUPIED, x[known] >= 3.0)
    assert not (whole[(x > 3.0 - 0.02) & known] == FREE).any()  # a corner reaches 0.031 m from the centre
    assert (whole[known & (x < 3.0 - 0.035) & (x > 0.2)] == FREE).mean() > 0.9
    assert not ((whole == FREE) & (centres != FREE)).any()
    assert (whole[centres == OCCUPIED] == OCCUPIED).all()  # any part of a cell makes it occupied
    assert not (whole[known & (x < 3.0 - 0.035)] == OCCUPIED).any()

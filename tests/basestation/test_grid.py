"""The grid: labels, layers, files, and that it follows corrections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from kiteline_basestation.config import GridConfig, GroundConfig
from kiteline_basestation.grid.grid import (
    GROUND,
    OBSTACLE,
    UNKNOWN,
    UNLABELLED,
    Grid,
    GridMap,
    build,
    dense,
    label,
    to_pgm,
    to_yaml,
)
from kiteline_basestation.grid.ground_height import ground_heights

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def room(slope: float = 0.0, floor_z: float = -1.0) -> tuple[F64, F64, I64]:
    """Cameras on a line through a 6x4 m room with a floor and four walls, each point seen by each camera before it."""
    rng = np.random.default_rng(7)
    floor = np.column_stack([rng.uniform([0.0, 0.0], [6.0, 4.0], (600, 2)), np.zeros(600)])
    along, height = rng.uniform(0, 1, 800), rng.uniform(0.2, 1.8, 800)
    side = np.arange(800) % 4
    x = np.choose(side, [6 * along, 6 * along, 0 * along, 6 + 0 * along])
    y = np.choose(side, [0 * along, 4 + 0 * along, 4 * along, 4 * along])
    points = np.concatenate([floor, np.column_stack([x, y, height])])
    points[:, 2] += floor_z + slope * points[:, 0]
    points += rng.normal(0.0, 0.01, points.shape)
    cameras = np.column_stack([np.linspace(1, 5, 12), np.full(12, 2.0), np.zeros(12)])
    cameras[:, 2] = floor_z + 1.0 + slope * cameras[:, 0]
    pairs = np.stack(np.meshgrid(np.arange(12), np.arange(len(points)), indexing="ij"), axis=-1).reshape(-1, 2)
    return cameras, points, pairs[rng.random(len(pairs)) < 0.3]


def at(grid: GridMap, x: float, y: float) -> int:
    cells, corner = dense(grid)
    row, column = int((y - corner[1]) / grid.cell_m), int((x - corner[0]) / grid.cell_m)
    return int(cells[row, column]) if row < cells.shape[0] and column < cells.shape[1] else UNKNOWN


@pytest.mark.parametrize("slope", [0.0, 0.06, 0.12])
def test_room_is_free_inside_solid_at_the_walls_and_unknown_outside(slope: float) -> None:
    cameras, points, pairs = room(slope)
    grid = build(GridConfig(), cameras, points, pairs)
    assert np.mean(grid.labels[:600] == GROUND) > 0.95
    assert np.mean(grid.labels[600:] == OBSTACLE) > 0.95
    seen = np.unique(pairs[:, 1])
    np.testing.assert_allclose(grid.ground_m[seen], -1.0 + slope * points[seen, 0], atol=0.03)
    cells, corner = dense(grid)
    rows, columns = np.indices(cells.shape)
    x, y = corner[0] + (columns + 0.5) * grid.cell_m, corner[1] + (rows + 0.5) * grid.cell_m
    inside = (x > 0.3) & (x < 5.7) & (y > 0.3) & (y < 3.7)
    outside = (x < -0.3) | (x > 6.3) | (y < -0.3) | (y > 4.3)
    assert np.mean((cells[inside] >= 0) & (cells[inside] <= 35)) > 0.97
    assert (cells[outside] == UNKNOWN).all()
    wall = (np.abs(y) < 0.1) & (x > 0.2) & (x < 5.8)
    assert np.mean(cells[wall] >= 65) > 0.3


def test_a_box_between_camera_and_floor_is_solid_and_nothing_is_known_behind_it() -> None:
    floor = np.column_stack([np.linspace(0.5, 2.5, 40), np.zeros(40), np.full(40, -0.4)])
    box = np.array([[3.05, 0.0, -0.2], [3.05, 0.02, -0.1], [3.05, 0.01, 0.0]])
    points = np.concatenate([floor, box])
    pairs = np.column_stack([np.zeros(43, np.int64), np.arange(43)])
    grid = build(GridConfig(), np.zeros((1, 3)), points, pairs)
    assert at(grid, 3.05, 0.05) > 65
    assert at(grid, 1.5, 0.05) < 35
    assert at(grid, 3.3, 0.05) == UNKNOWN


def test_rays_clear_only_obstacles_whose_heights_they_pass() -> None:
    """A wrong point in the air goes away when the wall behind is seen through it; a box under the rays stays."""
    camera = np.array([[0.05, 0.05, 1.0]])
    floor = np.column_stack([np.linspace(0.5, 1.5, 30), np.full(30, 0.05), np.zeros(30)])
    wall = np.column_stack([np.full(20, 4.05), np.full(20, 0.05), np.linspace(0.95, 1.05, 20)])
    floating = np.array([[2.05, 0.05, 1.0]])
    box = np.array([[2.05, 0.05, 0.3]])
    for middle, solid in ((floating, False), (box, True)):
        points = np.concatenate([floor, wall, middle])
        pairs = np.column_stack([np.zeros(51, np.int64), np.arange(51)])
        value = at(build(GridConfig(), camera, points, pairs), 2.05, 0.05)
        assert (value > 60) == solid, value


def test_labels_follow_height_and_distance() -> None:
    config = GridConfig()
    height = np.array([-0.5, -0.05, 0.05, 0.12, 0.12, 1.9, 2.1, np.nan])
    distance = np.array([1.0, 1.0, 1.0, 0.0, 10.0, 1.0, 1.0, 1.0])
    expected = [UNLABELLED, GROUND, GROUND, OBSTACLE, GROUND, OBSTACLE, UNLABELLED, UNLABELLED]
    assert label(config, height, distance).tolist() == expected


def test_ground_is_the_floor_and_neither_a_table_nor_noise_below() -> None:
    rng = np.random.default_rng(1)
    floor = np.column_stack([rng.uniform(0, 4, (200, 2)), rng.normal(0.0, 0.01, 200)])
    table = np.column_stack([rng.uniform(1, 3, (500, 2)), rng.normal(0.7, 0.01, 500)])
    noise = np.column_stack([rng.uniform(0, 4, (30, 2)), rng.uniform(-2.0, -0.2, 30)])
    points = np.concatenate([floor, table, noise])
    ground = ground_heights(GroundConfig(), points, np.full(len(points), 1.2))
    np.testing.assert_allclose(ground, 0.0, atol=0.06)


def test_without_floor_there_is_no_guess() -> None:
    cameras, points, pairs = room()
    points[:, 2] += 5.0  # all of it above the cameras
    grid = build(GridConfig(), cameras, points, pairs)
    assert np.isnan(grid.ground_m).all()
    assert not grid.labels.any()
    assert len(grid.tiles) == 0


def test_update_returns_exactly_the_tiles_that_changed() -> None:
    cameras, points, pairs = room()
    grid = Grid()
    first = grid.update(cameras, points, pairs)
    assert {(t.column, t.row) for t in first} == {(int(c), int(r)) for c, r in grid.map.tiles}
    assert all(t.cells.shape == (64, 64) and t.cells.dtype == np.int8 for t in first)
    assert grid.update(cameras, points, pairs) == ()
    shift = np.array([64 * grid.config.cell_m * 10, 0.0, 0.0])
    moved = grid.update(cameras + shift, points + shift, pairs)
    vanished = [t for t in moved if (t.cells == UNKNOWN).all()]
    assert {(t.column, t.row) for t in vanished} >= {(t.column, t.row) for t in first}


def test_shift_by_whole_tiles_shifts_the_grid() -> None:
    cameras, points, pairs = room()
    config = GridConfig(cell_m=0.125)  # exact in binary
    shift = np.array([8.0, -16.0, 0.0])  # one tile and minus two
    a, b = build(config, cameras, points, pairs), build(config, cameras + shift, points + shift, pairs)
    assert np.array_equal(a.tiles + [1, -2], b.tiles)
    assert np.mean(a.cells == b.cells) > 0.999


def test_bad_rows_are_left_out_and_bad_pairs_named() -> None:
    cameras, points, pairs = room()
    whole = build(GridConfig(), cameras, points, pairs)
    more = np.concatenate([points, [[np.nan, 0.0, 0.0]]])
    extra = np.concatenate([pairs, [[0, len(points)]]])
    assert np.array_equal(build(GridConfig(), cameras, more, extra).cells, whole.cells)
    with pytest.raises(ValueError, match="beyond 12 keyframes"):
        build(GridConfig(), cameras, points, np.array([[12, 0]]))
    with pytest.raises(ValueError, match="beyond 12 keyframes"):
        build(GridConfig(), cameras, points, np.array([[-1, 0]]))


def test_overlong_rays_are_dropped() -> None:
    near = np.column_stack([np.linspace(1.0, 2.0, 60), np.zeros(60), np.full(60, -1.0)])
    points = np.concatenate([near, [[12.0, 0.0, -1.0]]])
    pairs = np.column_stack([np.zeros(61, np.int64), np.arange(61)])
    free_below = replace(GridConfig(), free_below_m=5.0)
    grid = build(free_below, np.zeros((1, 3)), points, pairs)
    assert at(grid, 1.5, 0.05) < 35
    assert dense(grid)[0].shape[1] * grid.cell_m < 8.0


def test_pgm_and_yaml_are_what_map_server_reads() -> None:
    cameras, points, pairs = room()
    grid = build(GridConfig(), cameras, points, pairs)
    pgm = to_pgm(grid)
    magic, size, most, pixels = pgm.split(b"\n", 3)
    columns, rows = map(int, size.split())
    cells, corner = dense(grid)
    assert (magic, most, (rows, columns)) == (b"P5", b"255", cells.shape)
    image = np.frombuffer(pixels, np.uint8).reshape(rows, columns)
    assert set(np.unique(image)) == {0, 205, 254}
    occupied = (255.0 - image[::-1]) / 255.0  # the first row of an image is the highest y
    assert np.array_equal(occupied > 0.65, cells >= 65)
    assert np.array_equal(occupied < 0.196, (cells >= 0) & (cells <= 35))
    text = dict(line.split(": ", 1) for line in to_yaml(grid, "a.pgm").decode().splitlines())
    assert text["image"] == "a.pgm" and float(text["resolution"]) == grid.cell_m
    assert text["origin"] == f"[{corner[0]:.6f}, {corner[1]:.6f}, 0.000000]"
    nothing = build(GridConfig(), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2), np.int64))
    assert to_pgm(nothing).startswith(b"P5\n1 1\n255\n")

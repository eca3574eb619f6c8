"""True occupancy: what is solid, and what of it could be seen."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.source import open_sim
from kiteline_hw.sim.truth.box_files import read_boxes
from kiteline_hw.sim.truth.occupancy import FREE, OCCUPIED, UNKNOWN, TrueGrid, occupancy, write_grid
from kiteline_hw.sim.truth.sight import look
from kiteline_hw.sim.world.world import World, box_distances

LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a camera that looks along +x
CAMERA = CameraModel(160, 120, 80.0, 80.0, 79.5, 59.5, Lens.NONE, ())  # 90 degrees wide


def world_and_path(scene: str, **options: Any) -> tuple[World, np.ndarray]:
    source = open_sim(scene, texture_bits=7, scale=0.1, **options)
    return source.world, source.path.positions()


def boxes(tmp_path: Path, *rows: tuple[float, ...]) -> World:
    """A room of 8 by 6 by 3 m with its floor at z = 0 and its middle at the origin, and boxes in it."""
    file = tmp_path / "boxes.csv"
    lines = ["# comment", *(",".join(map(str, row)) for row in ((0, 0, 1.5, 4, 3, 1.5, 0), *rows))]
    file.write_text("\n".join(lines) + "\n")
    return read_boxes(file)


def value(grid: TrueGrid, x: float, y: float) -> int:
    c, r = ((np.array([x, y]) - grid.corner) / grid.cell_m).astype(int)
    return int(grid.image[r, c])


@pytest.mark.parametrize("scene", ["room", "corridor"])
def test_occupancy_matches_the_solids(scene: str) -> None:
    world, path = world_and_path(scene)
    cell = 0.05
    low, high = world.floor_m + 0.1, world.floor_m + 2.0
    grid = occupancy(world, 0.1, 2.0, cell)
    rng = np.random.default_rng(0)
    assert world.shell is not None
    shell = world.boxes[world.shell]
    xy = shell[:2] + rng.uniform(-1, 1, (4000, 2)) * shell[3:5]
    inside = np.zeros(len(xy), bool)
    distance = np.full(len(xy), np.inf)
    for box in world.solids():
        if box[2] - box[5] >= high or box[2] + box[5] <= low:
            continue
        at = np.column_stack([xy, np.full(len(xy), box[2])])
        d = box_distances(box, at)
        inside |= d == 0
        distance = np.minimum(distance, d)
    ij = ((xy - grid.corner) / cell).astype(int)
    values = grid.image[ij[:, 1], ij[:, 0]]
    assert (values[inside] == OCCUPIED).all()
    to_wall = (shell[3:5] - np.abs(xy - shell[:2])).min(1)
    assert (values[(distance > 0.1) & (to_wall > 0.1)] == FREE).all()
    assert inside.sum() > 50 and (values == FREE).sum() > 500
    ij = ((path[:, :2] - grid.corner) / cell).astype(int)
    assert (grid.image[ij[:, 1], ij[:, 0]] == FREE).mean() > 0.8, "solids above and below the path may show"
    assert grid.image[0, 0] == UNKNOWN


def test_files_hold_the_grid(tmp_path: Path) -> None:
    grid = occupancy(world_and_path("room")[0], 0.1, 2.0)
    write_grid(grid, tmp_path / "grid_0.1-0.5.yaml")
    back = cv2.imread(str(tmp_path / "grid_0.1-0.5.pgm"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(back[::-1], grid.image)
    text = (tmp_path / "grid_0.1-0.5.yaml").read_text()
    assert "image: grid_0.1-0.5.pgm\n" in text and f"origin: [{grid.corner[0]:.6f}" in text


def test_only_what_has_a_line_of_sight_is_known(tmp_path: Path) -> None:
    world = boxes(tmp_path, (1.0, 0.0, 0.5, 0.25, 0.5, 0.5, 0.0))  # 1 m high, 2.75 m ahead
    eye = se3.from_rt(LEVEL, np.array([-2.0, 0.0, 0.8]))
    seen = look(world, CAMERA, eye[None], range_m=5.5)
    everything, known = seen.grid(seen=False), seen.grid()
    assert value(everything, 1.0, 0.0) == OCCUPIED and value(known, 0.77, 0.0) == OCCUPIED
    assert value(everything, 2.5, 0.0) == FREE and value(known, 2.5, 0.0) == UNKNOWN  # behind the box
    assert value(everything, -3.0, 0.0) == FREE and value(known, -3.0, 0.0) == UNKNOWN  # behind the camera
    assert value(known, 0.0, 0.0) == FREE and value(known, 2.5, 2.5) == FREE
    assert value(known, -1.9, 0.0) == UNKNOWN  # below the image
    assert value(known, 3.9, 2.0) == UNKNOWN, "farther than the range"
    # The camera looks over the box: there only what stands higher is known.
    assert value(seen.grid(1.2, 2.0), 2.5, 0.0) == FREE
    assert value(seen.grid(0.1, 0.5), 2.5, 0.0) == UNKNOWN
    assert value(seen.grid(1.2, 2.0), 0.77, 0.0) == FREE and value(seen.grid(0.1, 0.5), 0.77, 0.0) == OCCUPIED


def test_a_table_top_fills_its_own_band(tmp_path: Path) -> None:
    world = boxes(tmp_path, (1.0, 0.0, 0.75, 0.4, 0.6, 0.02, 0.0))
    eyes = np.array([se3.from_rt(LEVEL, np.array([-2.0, y, z])) for y in (-0.5, 0.5) for z in (0.4, 1.0)])
    seen = look(world, CAMERA, eyes)
    assert value(seen.grid(0.5, 1.2), 0.62, 0.1) == OCCUPIED
    assert value(seen.grid(0.1, 0.5), 0.62, 0.1) == FREE
    assert value(seen.grid(), 0.62, 0.1) == OCCUPIED


def test_more_poses_never_know_less(tmp_path: Path) -> None:
    world = boxes(tmp_path, (1.0, 0.5, 0.5, 0.25, 0.5, 0.5, 0.3), (0.0, -1.0, 1.5, 0.1, 0.1, 1.5, 0.7))
    rng = np.random.default_rng(1)
    poses = []
    for _ in range(6):
        turn = se3.so3_exp(np.array([0.0, 0.0, rng.uniform(-3, 3)])) @ LEVEL
        poses.append(se3.from_rt(turn, np.array([rng.uniform(-3, -1), rng.uniform(-2, 2), 1.2])))
    few, many = look(world, CAMERA, np.array(poses[:3])), look(world, CAMERA, np.array(poses))
    assert not ((few.passed & ~many.passed) | (few.ended & ~many.ended)).any()
    known = many.grid()
    assert np.array_equal(known.image[known.image != UNKNOWN], many.grid(seen=False).image[known.image != UNKNOWN])
    assert (known.image == FREE).sum() > (few.grid().image == FREE).sum()


def test_a_grid_turns_with_its_camera(tmp_path: Path) -> None:
    """A quarter turn of room, box and camera turns what is seen."""
    ahead = look(
        boxes(tmp_path, (1.0, 0.5, 0.5, 0.2, 0.3, 0.5, 0.0)), CAMERA, se3.from_rt(LEVEL, np.array([-2.0, 0, 1.0]))[None]
    )
    quarter = se3.so3_exp(np.array([0.0, 0.0, 0.5 * np.pi]))
    world = boxes(tmp_path, (-0.5, 1.0, 0.5, 0.3, 0.2, 0.5, 0.0))
    world = replace(world, boxes=world.boxes.copy())
    world.boxes[0, 3:5] = 3.0, 4.0
    left = look(world, CAMERA, se3.from_rt(quarter @ LEVEL, np.array([0, -2.0, 1.0]))[None])
    a, b = ahead.grid().image, np.rot90(left.grid().image, 1)
    assert a.shape == b.shape and (a != b).mean() < 0.02  # rays along the borders of cells fall to either side


def test_boxes_that_are_none_are_refused(tmp_path: Path) -> None:
    for text in ("", "1,2,3\n", "0,0,0,1,1,-1,0\n", "a,b\n", "0,0,0,1,nan,1,0\n"):
        (tmp_path / "bad.csv").write_text(text)
        with pytest.raises(SourceError, match="bad"):
            read_boxes(tmp_path / "bad.csv")
    with pytest.raises(SourceError, match="absent"):
        read_boxes(tmp_path / "absent.csv")

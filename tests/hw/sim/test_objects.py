"""Objects and floors of indoor scenes that are hard on an occupancy grid."""

from typing import Any

import numpy as np
import pytest

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.sensors.camera import SimCamera
from kiteline_hw.sim.source import SimSource, open_sim
from kiteline_hw.sim.truth.occupancy import FREE, OCCUPIED, TrueGrid, occupancy
from kiteline_hw.sim.world.objects import KINDS
from kiteline_hw.sim.world.world import World, box_distances

DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])  # a camera that looks at the floor


def flight(scene: str, **options: Any) -> SimSource:
    return open_sim(scene, texture_bits=7, scale=0.1, **options)


def part(world: World, kind: str, number: int) -> np.ndarray:
    """One of the boxes of the first object of a kind."""
    first = next(first for name, first, _ in world.objects if name == kind)
    return world.boxes[first + number]


def value(grid: TrueGrid, xy: np.ndarray) -> int:
    c, r = ((xy - grid.corner) / grid.cell_m).astype(int)
    return int(grid.image[r, c])


@pytest.mark.parametrize("scene", ["room", "hall", "corridor"])
@pytest.mark.parametrize("seed", [1, 2])
def test_objects_of_all_kinds_stand_clear_of_path_and_solids(scene: str, seed: int) -> None:
    plain, furnished = flight(scene, seed=seed), flight(scene, seed=seed, objects=True)
    world, path = furnished.world, furnished.path.positions()
    assert {kind for kind, _, _ in world.objects} == set(KINDS)
    assert np.array_equal(world.boxes[: len(plain.world.boxes)], plain.world.boxes), "the rest of the world stays"
    for _, first, end in world.objects:
        for box in world.boxes[first:end]:
            assert box_distances(box, path).min() > 0.45
            middle = box[None, :3]
            assert min(float(box_distances(other, middle).min()) for other in plain.world.solids()) > 0.1


def test_true_grids_tell_legs_from_tops() -> None:
    world = flight("room", seed=1, objects=True).world
    low, middle = occupancy(world, 0.1, 0.5), occupancy(world, 0.5, 1.2)
    leg, top = part(world, "table", 0), part(world, "table", 4)
    assert value(low, leg[:2]) == OCCUPIED and value(low, top[:2]) == FREE and value(middle, top[:2]) == OCCUPIED
    post, leaf = part(world, "door", 0), part(world, "door", 1)
    turned = np.arctan2(leaf[7], leaf[6]) - np.arctan2(post[7], post[6])
    assert np.degrees(turned) % 360 == pytest.approx(45.0, abs=1e-6)
    assert value(occupancy(world, 0.1, 2.0), leaf[:2]) == OCCUPIED


def test_a_cylinder_is_round() -> None:
    world = flight("room", seed=1, objects=True).world
    _, first, end = next(o for o in world.objects if o[0] == "cylinder")
    centre, radius = world.boxes[first, :3], float(np.hypot(*world.boxes[first, 3:5]))
    around = np.linspace(0, 2 * np.pi, 720)
    ring = np.stack([np.cos(around), np.sin(around), 0 * around], 1)
    for factor, inside in ((0.985, True), (1.005, False)):
        points = centre + factor * radius * ring
        nearest = np.min([box_distances(box, points) for box in world.boxes[first:end]], axis=0)
        assert ((nearest == 0.0) == inside).all()


@pytest.mark.parametrize(
    ("floor", "fall"), [("ramp", (0.3, 2.0)), ("wave", (0.1, 0.13)), ("pits", (0.24, 0.26)), ("steps", (0.19, 0.21))]
)
def test_floors_fall_below_the_path_and_carry_the_furniture(floor: str, fall: tuple[float, float]) -> None:
    flat, source = flight("room", seed=1), flight("room", seed=1, floor=floor, objects=True)
    world, path = source.world, source.path.positions()
    assert world.shell is not None
    shell = world.boxes[world.shell]
    xy = shell[:2] + np.random.default_rng(0).uniform(-1, 1, (500, 2)) * shell[3:5]
    height = world.height(xy)
    assert fall[0] < world.floor_m - height.min() < fall[1] and height.max() <= world.floor_m + 1e-6
    assert (path[:, 2] - world.height(path[:, :2]) > 0.45).all()
    assert shell[2] - shell[5] < height.min()
    standing = flat.world.solids()
    standing = standing[standing[:, 2] - standing[:, 5] < flat.world.floor_m + 0.01]
    assert len(standing) > 3
    for box in world.solids()[: len(flat.world.solids())]:
        if any(np.array_equal(box[:2], other[:2]) for other in standing):
            assert box[2] - box[5] < world.height(box[None, :2])[0]
    leg, top = part(world, "table", 0), part(world, "table", 4)
    assert leg[2] - leg[5] < world.height(leg[None, :2])[0]
    assert top[2] - top[5] - world.height(top[None, :2])[0] == pytest.approx(0.72, abs=0.02)


@pytest.mark.parametrize("floor", ["ramp", "wave", "pits", "steps"])
def test_the_camera_sees_the_floor_where_it_is(floor: str) -> None:
    world = flight("room", seed=1, floor=floor).world
    camera = SimCamera(world, CameraModel(32, 24, 16.0, 16.0, 15.5, 11.5, Lens.NONE, ()), np.eye(4))
    assert world.shell is not None
    for x in (-1.0, 0.3, 1.2):
        eye = world.boxes[world.shell, :3] + [x, 0.4, -0.2]
        _, distance, hits = camera.cast(se3.from_rt(DOWN, eye))
        assert hits[12, 16] == -2
        assert distance[12, 16] == pytest.approx(eye[2] - world.height(eye[None, :2])[0], abs=0.02)


def test_a_bare_floor_shows_nothing() -> None:
    spread = {}
    for floor in ("flat", "bare"):
        world = flight("room", seed=1, floor=floor).world
        camera = SimCamera(world, CameraModel(32, 24, 160.0, 160.0, 15.5, 11.5, Lens.NONE, ()), np.eye(4))
        eye = np.array([*flight("room", seed=1).path.positions()[0][:2], world.floor_m + 0.6])
        radiance, _, hits = camera.cast(se3.from_rt(DOWN, eye))
        assert (hits == 6 * world.shell + 4).all()
        spread[floor] = float(radiance.std() / radiance.mean())
    assert spread["bare"] < 1e-4 < 0.01 < spread["flat"]


def test_unknown_floors_and_floors_of_streets_are_refused() -> None:
    with pytest.raises(SourceError, match="ramp, wave, pits, steps, bare"):
        open_sim("room?floor=lava")
    with pytest.raises(SourceError, match="indoor"):
        open_sim("street?floor=ramp")
    with pytest.raises(SourceError, match="indoor"):
        open_sim("street?objects=1")

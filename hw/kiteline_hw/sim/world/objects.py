"""Objects that are hard on an occupancy grid: chairs on thin legs, tables, cylinders, half-open doors, pillars."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kiteline_core.arrays import F64
from kiteline_hw.sim.world.world import Builder, World, box_distances

Parts = list[tuple[F64, F64, float]]  # centre, half-extents, yaw of each box; x, y about the object, z above the ground
Rng = np.random.Generator

_CLEARANCE_M = 0.5  # from the paths, as of all solids
_GAP_M = 0.15  # from other solids
_BURIED_M = 0.1  # m that what stands on the ground reaches into it: it need not be level
_TRIES = 400
_MATERIALS = (("wood", 0.68, 0.8), ("clutter", 0.8, 0.9), ("leaves", 0.9, 0.9), ("concrete", 0.54, 1.0))
_SIDES = 12  # boxes of a cylinder, which is a polygon of twice as many sides


def _box(x: float, y: float, low: float, high: float, hx: float, hy: float, yaw: float = 0.0) -> tuple[F64, F64, float]:
    return np.array([x, y, 0.5 * (low + high)]), np.array([hx, hy, 0.5 * (high - low)]), yaw


def _chair(rng: Rng) -> Parts:
    legs = [_box(x, y, -_BURIED_M, 0.45, 0.02, 0.02) for x in (-0.19, 0.19) for y in (-0.19, 0.19)]
    return [*legs, _box(0.0, 0.0, 0.43, 0.47, 0.21, 0.21), _box(-0.19, 0.0, 0.47, 0.9, 0.02, 0.21)]


def _table(rng: Rng) -> Parts:
    legs = [_box(x, y, -_BURIED_M, 0.72, 0.025, 0.025) for x in (-0.55, 0.55) for y in (-0.3, 0.3)]
    return [*legs, _box(0.0, 0.0, 0.72, 0.75, 0.6, 0.35)]


def _cylinder(rng: Rng) -> Parts:
    radius, height = rng.uniform(0.15, 0.25), rng.uniform(0.8, 1.3)
    half = 0.5 * np.pi / _SIDES
    return [
        _box(0.0, 0.0, -_BURIED_M, height, radius * np.cos(half), radius * np.sin(half), k * np.pi / _SIDES)
        for k in range(_SIDES)
    ]


def _door(rng: Rng) -> Parts:
    """A piece of wall, and a door that is hinged at its end and open by half a right angle."""
    turn = 0.25 * np.pi
    x, y = 0.05 + 0.43 * np.cos(turn), 0.43 * np.sin(turn)
    return [_box(-0.3, 0.0, -_BURIED_M, 2.1, 0.3, 0.06), _box(x, y, 0.01, 2.0, 0.43, 0.02, turn)]


def _pillar(rng: Rng) -> Parts:
    half = rng.uniform(0.08, 0.16)
    return [_box(0.0, 0.0, -_BURIED_M, 2.5, half, half)]


_KINDS: dict[str, tuple[Callable[[Rng], Parts], int]] = {
    "table": (_table, 1), "door": (_door, 1), "chair": (_chair, 3), "cylinder": (_cylinder, 2), "pillar": (_pillar, 3),
}  # fmt: skip
KINDS = tuple(_KINDS)


def with_objects(world: World, points: F64, seed: int) -> World:
    """The world with objects of all KINDS near the paths through points (n,3), where there is room for them."""
    rng = np.random.default_rng([seed, 97])
    builder = Builder(rng, world.pool, points, _CLEARANCE_M)
    objects = list(world.objects)
    solids = world.solids()
    for kind, (make, wanted) in _KINDS.items():
        for _ in range(wanted):
            parts = make(rng)
            placed = _place(world, solids, builder, parts)
            if placed is None:
                continue
            first = len(world.boxes) + len(builder.arrays()[0])
            material = _MATERIALS[int(rng.integers(len(_MATERIALS)))]
            for centre, half, yaw in placed:
                faces = np.stack([builder.face(*material, False) for _ in range(6)])
                builder.add(centre, half, yaw, faces, force=True)
            objects.append((kind, first, first + len(parts)))
            solids = np.concatenate([world.solids(), builder.arrays()[0]])
    boxes, faces = builder.arrays()
    return replace(
        world, boxes=np.concatenate([world.boxes, boxes]), faces=np.concatenate([world.faces, faces]),
        objects=tuple(objects),
    )  # fmt: skip


def _place(world: World, solids: F64, builder: Builder, parts: Parts) -> Parts | None:
    """The parts where they stand: beside a random point of a path, turned at random, free of all else."""
    assert world.shell is not None
    rng, shell = builder.rng, world.boxes[world.shell]
    radius = max(float(np.hypot(*centre[:2]) + np.hypot(*half[:2])) for centre, half, _ in parts)
    for _ in range(_TRIES):
        beside = builder.points[int(rng.integers(len(builder.points))), :2]
        way, turn = rng.uniform(0.0, 2 * np.pi, 2)
        away = _CLEARANCE_M + radius * rng.uniform(0.5, 1.0) + rng.uniform(0.0, 1.5)
        at = beside + away * np.array([np.cos(way), np.sin(way)])
        if (np.abs(at - shell[:2]) > shell[3:5] - radius).any():
            continue
        ground = float(world.height(at[None])[0])
        c, s = np.cos(turn), np.sin(turn)
        moved = [
            (np.array([at[0] + c * p[0] - s * p[1], at[1] + s * p[0] + c * p[1], ground + p[2]]), half, yaw + turn)
            for p, half, yaw in parts
        ]
        samples = np.concatenate([_samples(*placed) for placed in moved])
        if min(float(box_distances(box, samples).min()) for box in solids) < _GAP_M:
            continue
        if all(builder.clear(np.array([*p, *half, np.cos(yaw), np.sin(yaw)])) for p, half, yaw in moved):
            return moved
    return None


def _samples(centre: F64, half: F64, yaw: float) -> F64:
    """Points (n,3) spread over a box."""
    x, y, z = (half[k] * np.linspace(-1.0, 1.0, n) for k, n in enumerate((9, 9, 3)))
    p = np.stack(np.meshgrid(x, y, z), -1).reshape(-1, 3)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(centre + np.column_stack([c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1], p[:, 2]]))

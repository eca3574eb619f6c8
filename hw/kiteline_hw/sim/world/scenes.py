"""Indoor scenes, built around the paths flown in them."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_hw.sim.world.textures import make_pool
from kiteline_hw.sim.world.world import NO_GROUND, Builder, World

CLEARANCE_M = 0.5  # smallest distance of a solid from a path
SCENES = ("room", "hall", "corridor", "street")
_NO_FIELD = np.zeros(7)

_INDOOR_TEXTURES = ("leaves", "leaves2", "clutter", "posters", "plaster", "concrete", "wood", "brick")
# name, contrast, brightness, whether the texture is kept upright
_WALLS = (("posters", 0.81, 1.0, True), ("brick", 0.61, 0.8, True), ("plaster", 0.30, 1.15, True),
          ("clutter", 0.74, 0.95, False), ("leaves", 0.68, 0.9, False), ("concrete", 0.54, 0.95, True))  # fmt: skip
_FURNITURE = (("leaves", 0.94, 0.9, False), ("leaves2", 0.88, 1.0, False), ("clutter", 0.81, 0.9, False),
           ("wood", 0.68, 0.8, False), ("posters", 0.88, 1.05, False), ("concrete", 0.54, 1.0, False),
           ("plaster", 0.34, 1.1, False))  # fmt: skip


def build_indoor(scene: str, points: F64, seed: int, bits: int) -> World:
    """A room, hall or corridor around the paths through points (n, 3). Deterministic."""
    rng = np.random.default_rng([seed, 3, *scene.encode()])
    pool = make_pool(_INDOOR_TEXTURES, seed, bits)
    builder = Builder(rng, pool, points, CLEARANCE_M)
    low, high = points.min(0), points.max(0)
    side, above, least = {
        "room": (1.5, 0.9, (6.5, 8.0, 3.0)),
        "hall": (3.0, 2.5, (18.0, 14.0, 7.0)),
        "corridor": (1.6, 0.9, (0.0, 0.0, 2.6)),
    }[scene]
    floor = 0.0 if 0.6 <= low[2] <= 3.0 else float(low[2]) - 0.7
    half = 0.5 * np.maximum(high - low + 2 * side, least)
    top = max(float(high[2]) + above, floor + least[2])
    half[2] = 0.5 * (top - floor)
    centre = np.array([*(0.5 * (low + high))[:2], floor + half[2]])
    order = rng.permutation(len(_WALLS))
    faces = np.stack(
        [builder.face(*_WALLS[order[k]], 2 * half[2]) for k in range(4)]
        + [
            builder.face(*(("wood", 0.55, 0.75, False), ("concrete", 0.52, 0.85, False))[int(scene == "hall")]),
            builder.face(*(("plaster", 0.35, 1.15, False), ("clutter", 0.48, 0.95, False))[int(scene != "room")]),
        ]
    )
    builder.add(centre, half, 0.0, faces, force=True)
    if scene == "corridor":
        _add_walls(builder, centre, half)
        _add_panels(builder, floor)
    else:
        _add_furniture(builder, centre, half, scene)
    boxes, all_faces = builder.arrays()
    far = float(2.5 * np.linalg.norm(half))
    return World(boxes, all_faces, 0, NO_GROUND, _NO_FIELD, np.zeros((4, 8)), pool, far, floor)


def _furniture_faces(builder: Builder) -> F64:
    kinds = [_FURNITURE[int(k)] for k in builder.rng.integers(0, len(_FURNITURE), 2)]
    return np.stack([builder.face(*kinds[int(builder.rng.random() < 0.25)]) for _ in range(6)])


def _add_furniture(builder: Builder, centre: F64, half: F64, scene: str) -> None:
    """Add crates, shelves, pictures and pillars, most of them along the walls, none on a path."""
    rng = builder.rng
    floor = centre[2] - half[2]
    area = 4 * half[0] * half[1]
    big = 1.0 if scene == "room" else 1.8
    wanted = int(min(22, 8 + area / 6) if scene == "room" else min(70, 14 + area / 8))
    placed = tries = 0
    while placed < wanted and tries < 40 * wanted:
        tries += 1
        size = big * rng.uniform([0.2, 0.2, 0.2], [0.5, 0.5, 0.75])
        xy = centre[:2] + rng.uniform(-1, 1, 2) * (half[:2] - 0.2)
        if rng.random() < 0.65:  # against a wall
            axis = int(rng.integers(0, 2))
            xy[axis] = centre[axis] + np.sign(rng.uniform(-1, 1)) * (half[axis] - size[axis] - rng.uniform(0.0, 0.3))
        z = floor + size[2]
        if rng.random() < 0.2:
            z += rng.uniform(0.0, 0.6) * 2 * half[2]
        placed += builder.add(np.array([*xy, z]), size, rng.uniform(0, np.pi), _furniture_faces(builder))
    for _ in range(8 if scene == "room" else 24):  # objects that hang on the walls
        axis, sign = int(rng.integers(0, 2)), float(rng.choice([-1.0, 1.0]))
        size = np.array([rng.uniform(0.2, 0.7), rng.uniform(0.2, 0.7), rng.uniform(0.2, 0.5)]) * big
        size[axis] = rng.uniform(0.01, 0.12)
        xy = centre[:2] + rng.uniform(-0.85, 0.85, 2) * half[:2]
        xy[axis] = centre[axis] + sign * (half[axis] - size[axis])
        z = floor + rng.uniform(0.25, 0.85) * 2 * half[2]
        builder.add(np.array([*xy, z]), size, 0.0, _furniture_faces(builder))
    if scene == "hall":
        for _ in range(12):
            xy = centre[:2] + rng.uniform(-0.8, 0.8, 2) * half[:2]
            width = rng.uniform(0.15, 0.35)
            builder.add(np.array([*xy, centre[2]]), np.array([width, width, half[2]]), 0.0, _furniture_faces(builder))
        for y in np.linspace(-0.8, 0.8, 6) * half[1] + centre[1]:  # beams under the ceiling
            at = np.array([centre[0], y, floor + 2 * half[2] - 0.3])
            builder.add(at, np.array([half[0], 0.12, 0.2]), 0.0, _furniture_faces(builder))


def _add_walls(builder: Builder, centre: F64, half: F64) -> None:
    """Fill the space farther than a corridor's width from every path with walls from floor to ceiling."""
    cell = 0.5
    columns, rows = (int(v) for v in np.ceil(2 * half[:2] / cell))
    lower = centre[:2] - half[:2]
    flat = np.unique(np.round(builder.points[:, :2] / 0.2).astype(int), axis=0) * 0.2
    solid = np.ones((rows, columns), bool)
    y, x = np.mgrid[:rows, :columns]
    middle = lower + np.stack([x, y], 2) * cell + 0.5 * cell
    for p in flat:
        solid &= np.abs(middle - p).max(2) > 1.5
    while solid.any():  # cover the solid cells with rectangles, greedily
        j, i = (int(v[0]) for v in np.nonzero(solid))
        i1 = i
        while i1 < columns and solid[j, i1]:
            i1 += 1
        j1 = j
        while j1 < rows and solid[j1, i:i1].all():
            j1 += 1
        solid[j:j1, i:i1] = False
        size = 0.5 * cell * np.array([i1 - i, j1 - j])
        at = lower + cell * np.array([i, j]) + size
        kinds = [_WALLS[int(k)] for k in builder.rng.integers(0, len(_WALLS), 6)]
        faces = np.stack([builder.face(*kind, half[2]) for kind in kinds])
        builder.add(np.array([*at, centre[2]]), np.array([*size, half[2]]), 0.0, faces)


def _add_panels(builder: Builder, floor: float) -> None:
    """Add doors, boards, cupboards and pipes to the corridor's walls, which are found by probing sideways."""
    rng = builder.rng
    boxes, _ = builder.arrays()
    shell, walls = boxes[0], boxes[1:]
    step = np.linspace(0.6, 2.2, 33)
    for i in range(0, len(builder.points), 9):
        axis, sign = int(rng.integers(0, 2)), float(rng.choice([-1.0, 1.0]))
        p = builder.points[i]
        probe = np.tile(p[:2], (len(step), 1))
        probe[:, axis] += sign * step
        inside = (np.abs(probe - shell[:2]) > shell[3:5]).any(1)
        for w in walls:
            inside |= (np.abs(probe - w[:2]) < w[3:5]).all(1)
        if not inside.any():
            continue
        size = np.array([rng.uniform(0.1, 0.5), rng.uniform(0.1, 0.5), rng.uniform(0.15, 0.9)])
        size[axis] = rng.choice([0.02, 0.04, 0.15])
        at = np.array([*p[:2], floor + max(size[2], rng.uniform(0.2, 2.2))])
        at[axis] = probe[int(np.argmax(inside)), axis]
        builder.add(at, size, 0.0, _furniture_faces(builder))

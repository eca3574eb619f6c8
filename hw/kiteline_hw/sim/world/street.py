"""A street along the paths: a road at their height, pavements, houses, parked cars, poles and trees."""

from collections.abc import Callable

import cv2
import numpy as np

from kiteline_core.arrays import F32, F64
from kiteline_hw.sim.world.textures import make_pool
from kiteline_hw.sim.world.world import Builder, World, bilinear

CAMERA_HEIGHT_M = 1.65  # m of the path above the road
CLEARANCE_M = 0.6
CELL_M = 1.0  # m; cell of the ground's field
MARGIN_M = 70.0  # m of the field around the paths
ROAD_M, PAVEMENT_M = 3.8, 6.2  # half-width of the road, far side of the pavement
FAR_M = 400.0

_TEXTURES = ("facade", "facade2", "facade3", "leaves", "clutter", "posters", "asphalt", "foliage", "concrete", "clouds")


def build_street(points: F64, seed: int, bits: int) -> World:
    """A street along the paths through points (n, 3). Deterministic."""
    rng = np.random.default_rng([seed, 5])
    pool = make_pool(_TEXTURES, seed, bits)
    field, frame = ground_field(points)
    builder = Builder(rng, pool, points, CLEARANCE_M)
    along, sides = _stations(points)
    site = _Site(builder, field, frame)
    _add_houses(builder, site, along, sides)
    _add_furniture(site, along, sides)
    boxes, faces = builder.arrays()
    ground = np.stack(
        [
            builder.face("asphalt", 0.45, 0.62, False),
            builder.face("concrete", 0.40, 0.85, False),
            builder.face("foliage", 0.50, 0.55, False),
            builder.face("clouds", 0.12, 1.25, False),
        ]
    )
    start = float(bilinear(field[0], frame, points[:1, :2])[0])
    return World(boxes, faces, None, field, frame, ground, pool, FAR_M, start)


def ground_field(points: F64) -> tuple[F32, F64]:
    """Height and distance to the path (2, rows, columns), and its frame (7,): x0 y0 cell slope 0 road pavement.

    The height is that of the paths less CAMERA_HEIGHT_M, extended by normalised convolution from coarse to fine widths,
    then lowered so that no path comes nearer to it than CLEARANCE_M.
    """
    lower = np.floor(points[:, :2].min(0) - MARGIN_M)
    columns, rows = (int(v) for v in np.ceil((points[:, :2].max(0) + MARGIN_M - lower) / CELL_M) + 1)
    ij = np.round((points[:, :2] - lower) / CELL_M).astype(int)
    total, weight = np.zeros((rows, columns)), np.zeros((rows, columns))
    np.add.at(total, (ij[:, 1], ij[:, 0]), points[:, 2] - CAMERA_HEIGHT_M)
    np.add.at(weight, (ij[:, 1], ij[:, 0]), 1.0)
    total, weight = np.where(weight > 0, total / np.maximum(weight, 1), 0.0), np.minimum(weight, 1.0)
    height = np.full((rows, columns), float(points[:, 2].mean()) - CAMERA_HEIGHT_M)
    for width in (48.0, 24.0, 12.0, 6.0, 3.0):
        w = _blur(weight, width)
        keep = 1e-3
        height = (_blur(total, width) + keep * height) / (w + keep)
        height = _blur(height, 0.25 * width)
    gap = points[:, 2] - bilinear(height.astype(np.float32), np.array([*lower, CELL_M]), points[:, :2])
    height -= max(0.0, CLEARANCE_M + 0.05 - float(gap.min()))
    free = np.where(weight > 0, 0, 255).astype(np.uint8)
    coarse = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
    slope = np.hypot(*np.gradient(height, CELL_M)).max() * 1.5 + 0.02
    field = np.stack([height, _blur(coarse.astype(np.float64), 1.0)]).astype(np.float32)
    return field, np.array([*lower, CELL_M, float(slope), 0.0, ROAD_M, PAVEMENT_M])


def _blur(image: F64, sigma_cells: float) -> F64:
    """Gaussian blur with replicated borders; one separable convolution, so that the order of sums is fixed."""
    radius = int(np.ceil(3 * sigma_cells))
    x = np.arange(-radius, radius + 1)
    kernel = np.exp(-0.5 * (x / sigma_cells) ** 2)
    kernel /= kernel.sum()
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REPLICATE))


def _stations(points: F64) -> tuple[F64, F64]:
    """Points along the path (m, 3), one per half metre, and the unit vectors (m, 2) to its left."""
    step = max(1, round(0.5 / max(1e-6, float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))))))
    p = points[::step]
    ahead = np.roll(p, -3, axis=0)[:, :2] - np.roll(p, 3, axis=0)[:, :2]
    length = np.linalg.norm(ahead, axis=1)
    good = (length > 0.5) & (length < 12.0)
    ahead = ahead[good] / length[good, None]
    return p[good], np.stack([-ahead[:, 1], ahead[:, 0]], 1)


class _Site:
    """The ground that boxes are put on."""

    def __init__(self, builder: Builder, field: F32, frame: F64) -> None:
        self._builder, self._field, self._frame = builder, field, frame
        self.rng = builder.rng

    def put(self, xy: F64, half: F64, yaw: float, faces: F64, lift: float = 0.0) -> bool:
        """Add a box on the ground, its bottom below the lowest ground under it, or `lift` m above the ground.

        False if it comes too near to a path.
        """
        reach = np.hypot(half[0], half[1]) * 0.7
        around = xy + reach * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        height = bilinear(self._field[0], self._frame, around)
        bottom = float(height[0]) + lift if lift > 0 else float(height.min()) - 0.1
        top = float(height[0]) + lift + 2 * half[2]
        size = np.array([half[0], half[1], 0.5 * (top - bottom)])
        return self._builder.add(np.array([*xy, 0.5 * (top + bottom)]), size, yaw, faces)

    def faces(self, texture: str, contrast: float, brightness: float) -> F64:
        """The six faces of a box of one material."""
        return np.stack([self._builder.face(texture, contrast, brightness, False) for _ in range(6)])


def _add_houses(builder: Builder, site: _Site, along: F64, sides: F64) -> None:
    """Add rows of houses on both sides, beyond the pavement and without overlap."""
    rng = builder.rng
    flat = along[:, :2]
    taken = np.zeros((0, 3))
    for sign in (-1.0, 1.0):
        i = 0
        while i < len(along):
            half = rng.uniform([4.0, 3.0, 2.5], [8.0, 6.0, 7.0])
            back = rng.uniform(7.5, 11.0) if rng.random() < 0.8 else rng.uniform(12.0, 22.0)
            xy = flat[i] + sign * sides[i] * (back + half[1])
            yaw = float(np.arctan2(-sides[i, 0], sides[i, 1])) + rng.normal(0, 0.04)
            i += int(2.0 * (2 * half[0] + (rng.uniform(0.0, 3.0) if rng.random() < 0.7 else rng.uniform(4.0, 18.0))))
            near = np.linalg.norm(taken[:, :2] - xy, axis=1) < 0.75 * (taken[:, 2] + half[0])
            if near.any():
                continue
            c, s = np.cos(yaw), np.sin(yaw)
            d = flat - xy
            x, y = np.abs(c * d[:, 0] + s * d[:, 1]) - half[0], np.abs(c * d[:, 1] - s * d[:, 0]) - half[1]
            if (np.maximum(x, y) < PAVEMENT_M + 0.5).any():
                continue
            front = str(rng.choice(["facade", "facade2", "facade3", "facade", "clutter", "concrete"]))
            wall = builder.face(front, 0.62, rng.uniform(0.7, 1.15), True, half[2] + 0.1)
            walls = np.tile(wall, (6, 1))
            walls[:, 2] = rng.uniform(0, 2048, 6)
            walls[4:] = builder.face("concrete", 0.5, 0.6, False)
            site.put(xy, half, yaw, walls)
            taken = np.vstack([taken, [*xy, half[0]]])
            if rng.random() < 0.8:  # a roof storey set back, of another material
                attic = half * np.array([0.85, 0.7, 0.0]) + np.array([0.0, 0.0, rng.uniform(0.5, 1.4)])
                site.put(xy, attic, yaw, site.faces("clutter", 0.5, 0.55), lift=2 * half[2])


def _add_furniture(site: _Site, along: F64, sides: F64) -> None:
    """Add cars, poles, trees, hedges, bins and signs on both sides of the road."""
    for sign in (-1.0, 1.0):
        i = 0
        while i < len(along):
            yaw = float(np.arctan2(-sides[i, 0], sides[i, 1]))
            kind = site.rng.random()
            add, gap = next((add, gap) for below, add, gap in _FURNITURE if kind < below)
            add(site, along[i, :2], sign * sides[i], yaw)
            i += int(site.rng.integers(*gap))


def _add_car(site: _Site, at: F64, side: F64, yaw: float) -> None:
    rng = site.rng
    half = rng.uniform([1.9, 0.8, 0.40], [2.4, 0.95, 0.55])
    xy = at + side * rng.uniform(2.6, 3.1)
    name = str(rng.choice(["clutter", "leaves", "concrete"]))
    if site.put(xy, half, yaw, site.faces(name, 0.35, rng.uniform(0.35, 1.2))):
        cabin = np.array([0.55 * half[0], 0.9 * half[1], 0.3])
        site.put(xy, cabin, yaw, site.faces("facade2", 0.5, 0.5), lift=2 * half[2])


def _add_pole(site: _Site, at: F64, side: F64, yaw: float) -> None:
    """A pole, on most of them a sign."""
    rng = site.rng
    width = rng.uniform(0.06, 0.14)
    half = np.array([width, width, rng.uniform(1.5, 4.0)])
    xy = at + side * rng.uniform(4.2, 5.6)
    if site.put(xy, half, yaw, site.faces("concrete", 0.5, 0.7)) and rng.random() < 0.6:
        board = np.array([0.04, rng.uniform(0.25, 0.6), rng.uniform(0.2, 0.5)])
        site.put(xy, board, yaw, site.faces("posters", 0.7, 1.1), lift=2 * half[2])


def _add_tree(site: _Site, at: F64, side: F64, yaw: float) -> None:
    """A trunk with a crown of turned blocks."""
    rng = site.rng
    trunk = np.array([0.15, 0.15, rng.uniform(0.9, 1.6)])
    xy = at + side * rng.uniform(5.2, 9.0)
    if not site.put(xy, trunk, yaw, site.faces("concrete", 0.7, 0.45)):
        return
    for _ in range(4):
        crown = rng.uniform([0.5, 0.5, 0.5], [1.3, 1.3, 1.2])
        where = xy + rng.normal(0, 0.5, 2)
        lift = 2 * trunk[2] + rng.uniform(-0.3, 1.2)
        site.put(where, crown, rng.uniform(0, 3), site.faces("foliage", 0.75, 0.6), lift)


def _add_low(site: _Site, at: F64, side: F64, yaw: float) -> None:
    """A hedge, a bin or a box."""
    rng = site.rng
    half = rng.uniform([0.3, 0.25, 0.4], [2.5, 0.5, 0.8])
    name = str(rng.choice(["foliage", "posters", "clutter", "leaves"]))
    site.put(at + side * rng.uniform(5.0, 7.0), half, yaw, site.faces(name, 0.6, 0.8))


# What stands beside the road: the draw in [0, 1) below which it is chosen, what adds it, and half metres to the next.
_FURNITURE: tuple[tuple[float, Callable[[_Site, F64, F64, float], None], tuple[int, int]], ...] = (
    (0.30, _add_car, (11, 30)),
    (0.50, _add_pole, (8, 24)),
    (0.80, _add_tree, (8, 26)),
    (1.00, _add_low, (6, 20)),
)

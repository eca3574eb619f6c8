"""Occupancy grid of the x-y plane of w (z up), built from landmarks and the rays that observe them.

    grid = Grid(GridConfig())
    changed = grid.adopt(build(config, positions, points, observations))   # tuple[GridTile, ...] to send
    grid.map.labels                                          # (m,) 0 unlabelled, 1 ground, 2 obstacle
    files = to_pgm(grid.map), to_yaml(grid.map, "grid.pgm")  # bytes for base/grid.pgm and base/grid.yaml

`build` is pure and makes the whole grid anew, so that corrections of keyframes need no book-keeping.

Method: "Segfloor" section 5.6 (points above the ground, and rays to ground points, overlong rays dropped by equation
5.3), extended by rays to obstacle points, log-odds (A. Hornung et al., "OctoMap", 2013, equation 2) and the heights of
rays: a ray over a box clears neither the box nor the floor below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid import grid_kernels as kernels
from kiteline_basestation.grid.ground_height import ground_heights
from kiteline_codec.schema import GridTile

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I8 = NDArray[np.int8]
U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

_T = TypeVar("_T", bound=np.generic)

TILE = kernels.TILE
_QUARTILE = 0.675  # of a normal distribution, in standard deviations
UNKNOWN = -1

UNLABELLED, GROUND, OBSTACLE = 0, 1, 2  # labels of map points


@dataclass(frozen=True, slots=True)
class GridMap:
    """A finished grid. Its arrays are never written again.

    tiles: (t, 2) int64 column, row of each tile, in order of row, column. cells: (t, 64, 64) int8, 0..100 percent
    occupied, -1 unknown, row 0 the lowest y. A tile's corner lies at (column, row) * 64 * cell_m in w.
    points: (m,3) landmarks in w. labels: (m,) uint8 of the points. ground_m: (m,) z of the ground at each, NaN unknown.
    """

    cell_m: float
    tiles: I64
    cells: I8
    points: F64
    labels: U8
    ground_m: F64


def empty(config: GridConfig, points: F64 | None = None) -> GridMap:
    """A grid without tiles. points: (m,3)."""
    points = np.zeros((0, 3)) if points is None else points
    return GridMap(
        config.cell_m,
        np.zeros((0, 2), np.int64),
        np.zeros((0, TILE, TILE), np.int8),
        points,
        np.zeros(len(points), np.uint8),
        np.full(len(points), np.nan),
    )


class Grid:
    """The newest grid."""

    def __init__(self, config: GridConfig | None = None) -> None:
        self.config = config or GridConfig()
        self.map = empty(self.config)

    def update(self, positions: F64, points: F64, observations: I64) -> tuple[GridTile, ...]:
        """Build the grid of the whole map and return the tiles that changed; arguments as for `build`."""
        return self.adopt(build(self.config, positions, points, observations))

    def adopt(self, new: GridMap) -> tuple[GridTile, ...]:
        """Replace the grid by one from `build`. Returns the changed tiles; one that vanished is returned as unknown."""
        changed = differences(self.map, new)
        self.map = new
        return changed


def differences(old: GridMap, new: GridMap) -> tuple[GridTile, ...]:
    """Tiles that differ between two grids, as in `new`, in order of row, column; vanished ones as unknown."""
    before, after = _by_place(old), _by_place(new)
    unknown = np.full((TILE, TILE), UNKNOWN, np.int8)
    out = []
    for place in sorted(before.keys() | after.keys()):
        cells = after.get(place, unknown)
        if place not in before or not np.array_equal(cells, before[place]):
            out.append(GridTile(place[1], place[0], 0, new.cell_m, cells))
    return tuple(out)


def _by_place(grid: GridMap) -> dict[tuple[int, int], I8]:
    return {(int(r), int(c)): cells for (c, r), cells in zip(grid.tiles, grid.cells, strict=True)}


def build(config: GridConfig, positions: F64, points: F64, observations: I64) -> GridMap:
    """Build the grid of a whole map.

    positions: (n,3) keyframe cameras in w, m. points: (m,3) landmarks in w, m. observations: (k,2) int64 pairs (row of
    positions, row of points). Rows that are not finite are ignored. Raises ValueError for a pair that names no row.
    """
    rows, columns = len(positions), len(points)
    pairs = observations.reshape(-1, 2)
    if len(pairs) and (pairs.min() < 0 or pairs[:, 0].max() >= rows or pairs[:, 1].max() >= columns):
        raise ValueError(f"an observation names a row beyond {rows} keyframes and {columns} points")
    finite_kf: Bool = np.asarray(np.isfinite(positions).all(axis=1))
    finite_pt: Bool = np.asarray(np.isfinite(points).all(axis=1))
    seen = pairs[finite_kf[pairs[:, 0]] & finite_pt[pairs[:, 1]]]
    ray = points[seen[:, 1]] - positions[seen[:, 0]]
    length = np.hypot(ray[:, 0], ray[:, 1])
    near = length <= config.max_ray_m
    seen, length = seen[near], length[near]
    if not len(seen):
        return empty(config, points)
    distance = np.full(len(points), np.inf)
    np.minimum.at(distance, seen[:, 1], length)
    camera_z = np.full(len(points), np.inf)
    np.minimum.at(camera_z, seen[:, 1], positions[seen[:, 0], 2])
    used = np.isfinite(distance)

    ground = np.full(len(points), np.nan)
    ground[used] = ground_heights(config.ground, points[used], camera_z[used])
    labels = label(config, points[:, 2] - ground, distance)
    views = np.bincount(seen[:, 1], minlength=len(points))
    keep = (labels[seen[:, 1]] != UNLABELLED) & ~_overlong(config, seen, length, labels)
    return _draw(config, positions, points, ground, labels, views, seen[keep])


def label(config: GridConfig, height_m: F64, distance_m: F64) -> U8:
    """Label points by height above the ground (n,) and distance of the nearest view (n,), both m: (n,) uint8."""
    band = config.obstacle_low_m + config.noise_per_m * np.where(np.isfinite(distance_m), distance_m, 0.0)
    out = np.zeros(len(height_m), np.uint8)
    out[np.abs(height_m) <= band] = GROUND  # comparisons with NaN are false: points without ground stay unlabelled
    out[(height_m > band) & (height_m <= config.vehicle_height_m)] = OBSTACLE
    return out


def _overlong(config: GridConfig, seen: I64, length: F64, labels: U8) -> Bool:
    """Rays to ground points that are outliers in length among their keyframe's (Segfloor, equations 5.3 and 5.5)."""
    floor = labels[seen[:, 1]] == GROUND
    n = int(seen[:, 0].max()) + 1
    count = np.maximum(np.bincount(seen[floor, 0], minlength=n), 1)
    mean = np.bincount(seen[floor, 0], length[floor], n) / count
    variance = np.bincount(seen[floor, 0], length[floor] ** 2, n) / count - mean**2
    sigma = np.sqrt(np.maximum(variance, 0.0))
    upper = mean + (1.0 + 2.0 * config.fence) * _QUARTILE * sigma
    return np.asarray(floor & (length > upper[seen[:, 0]] + 1e-9))


def _draw(config: GridConfig, positions: F64, points: F64, ground: F64, labels: U8, views: I64, seen: I64) -> GridMap:
    """Add obstacle points and rays to tiles, and convert counts to percent."""
    if not len(seen):
        return replace(empty(config, points), labels=labels, ground_m=ground)
    obstacle = np.flatnonzero(labels == OBSTACLE)
    cameras, ends = np.unique(seen[:, 0]), np.flatnonzero(np.bincount(seen[:, 1]))
    first_tile, last_tile = _tile_box(config.cell_m, positions[cameras, :2], points[ends, :2], points[obstacle, :2])
    columns, rows = last_tile - first_tile + 1
    origin = first_tile * TILE
    slots = np.full((rows, columns), -1, np.int32)

    capacity = int(min(rows * columns, len(obstacle) + 256)) + 8
    hits, free, through = (np.zeros((capacity, TILE, TILE), np.uint16) for _ in range(3))
    low = np.full((capacity, TILE, TILE), np.inf, np.float32)
    high = np.full((capacity, TILE, TILE), -np.inf, np.float32)
    solid = _cells(config.cell_m, points[obstacle]) - origin
    used = kernels.mark_points(
        solid[:, 0], solid[:, 1], points[obstacle, 2], views[obstacle], slots, 0, hits, low, high
    )
    z = np.stack([positions[seen[:, 0], 2], points[seen[:, 1], 2]], axis=1)
    to_obstacle = labels[seen[:, 1]] == OBSTACLE
    ceiling = ground[seen[:, 1]] + np.where(to_obstacle, config.clear_below_m, config.free_below_m)
    short = to_obstacle.astype(np.int64)
    start = _cells(config.cell_m, positions[seen[:, 0]]) - origin
    end = _cells(config.cell_m, points[seen[:, 1]]) - origin
    done = 0
    while True:
        done, used = kernels.cast_rays(
            start, end, z, ceiling, short, done, slots, used, 0.5 * config.cell_m, free, through, low, high
        )
        if done == len(start):
            break
        more = len(free) + 64
        hits, free, through = (_grow(a, more, 0) for a in (hits, free, through))
        low, high = _grow(low, more, np.inf), _grow(high, more, -np.inf)

    cells = percent(config, hits[:used], free[:used], through[:used])
    r, c = np.nonzero(slots >= 0)
    order = slots[r, c]
    return GridMap(config.cell_m, np.stack([c, r], axis=1) + first_tile, cells[order], points, labels, ground)


def _cells(cell_m: float, points: F64) -> I64:
    """Column and row (n,2) of the cells of points (n, 2 or 3)."""
    return np.asarray(np.floor(points[:, :2] / cell_m).astype(np.int64))


def _tile_box(cell_m: float, *points: F64) -> tuple[I64, I64]:
    """Column and row of the first and the last tile of points (n,2)."""
    cells = np.concatenate([_cells(cell_m, p) for p in points])
    return cells.min(axis=0) // TILE, cells.max(axis=0) // TILE


def _grow(a: NDArray[_T], more: int, fill: float) -> NDArray[_T]:
    return np.concatenate([a, np.full((more, TILE, TILE), fill, a.dtype)])


def percent(config: GridConfig, hits: NDArray[np.uint16], free: NDArray[np.uint16], through: NDArray[np.uint16]) -> I8:
    """Percent occupied (int8, -1 unknown) from counts of views, of rays over and of rays through each cell."""
    odds = np.where(
        hits > 0, config.log_hit * hits + config.log_through * through, config.log_free * free.astype(np.float64)
    )
    p = 100.0 / (1.0 + np.exp(-np.clip(odds, -config.log_limit, config.log_limit)))
    return np.where((hits > 0) | (free > 0), np.rint(p), UNKNOWN).astype(np.int8)


def states(percent: I8) -> I8:
    """Cells as a GridTile has them, of percent occupied."""
    solid = np.where(percent >= OCCUPIED_FROM, 7, UNKNOWN)
    return np.where((percent >= 0) & (percent <= FREE_UP_TO), 0, solid).astype(np.int8)


def dense(grid: GridMap) -> tuple[I8, F64]:
    """The whole grid as one array: cells (rows, columns) int8, row 0 the lowest y, and its corner (2,) in w, m."""
    if not len(grid.tiles):
        return np.full((1, 1), UNKNOWN, np.int8), np.zeros(2)
    first = grid.tiles.min(axis=0)
    columns, rows = (grid.tiles.max(axis=0) - first + 1) * TILE
    out = np.full((rows, columns), UNKNOWN, np.int8)
    for (c, r), cells in zip((grid.tiles - first) * TILE, grid.cells, strict=True):
        out[r : r + TILE, c : c + TILE] = cells
    return out, first * TILE * grid.cell_m


FREE_GREY, UNKNOWN_GREY, SOLID_GREY = 254, 205, 0  # as map_server writes them
OCCUPIED_FROM = 65  # percent; map_server's occupied_thresh
FREE_UP_TO = 35  # percent; one ray over a cell suffices


def to_pgm(grid: GridMap) -> bytes:
    """The grid as a map_server image (binary PGM, highest y first): 254 free, 0 occupied, 205 unknown."""
    cells, _ = dense(grid)
    grey = np.full(cells.shape, UNKNOWN_GREY, np.uint8)
    grey[(cells >= 0) & (cells <= FREE_UP_TO)] = FREE_GREY
    grey[cells >= OCCUPIED_FROM] = SOLID_GREY
    return f"P5\n{cells.shape[1]} {cells.shape[0]}\n255\n".encode() + grey[::-1].tobytes()


def to_yaml(grid: GridMap, image: str = "grid.pgm") -> bytes:
    """The map_server description of `to_pgm`; origin is the lower left corner in w, m."""
    _, corner = dense(grid)
    return (
        f"image: {image}\nmode: trinary\nresolution: {grid.cell_m:.6g}\n"
        f"origin: [{corner[0]:.6f}, {corner[1]:.6f}, 0.000000]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    ).encode()

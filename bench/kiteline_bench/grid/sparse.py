"""Reference methods, which draw occupancy grids from sparse points alone.

`log_odds_grid`: points above the ground, and rays to all points, as log-odds by height. `binary_grid`: Segfloor,
section 5.6: a layer of obstacle points over a layer of rays to ground points.
"""

from dataclasses import dataclass

import numpy as np

from kiteline_basestation.grid.ground_height import ground_heights
from kiteline_bench.grid.ray_kernels import cast_rays
from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_lab.grids.files import FREE, OCCUPIED, UNKNOWN, GridFile

UNLABELLED, GROUND, OBSTACLE = 0, 1, 2
MAX_RAY_M = 20.0  # m; beyond, the error of a stereo point exceeds a cell
_LOW_M, _HIGH_M = 0.1, 2.0  # m above the ground, of obstacles
_NOISE_PER_M = 0.01  # m/m; height noise by distance
_FREE_BELOW_M, _CLEAR_BELOW_M = 0.7, 0.5  # m above the ground, up to which rays to ground and to obstacles free cells
_HIT, _THROUGH, _FREE = 0.6, -0.3, -0.7  # log-odds of a view of an obstacle, of a ray through it, of a ray over a cell
_FREE_UP_TO, _OCCUPIED_FROM = np.log(0.35 / 0.65), np.log(0.65 / 0.35)  # log-odds
_QUARTILE, _FENCE = 0.675, 1.5  # Segfloor, equations 5.3 and 5.5


@dataclass(frozen=True, slots=True)
class SparsePoints:
    """Keyframe cameras (n,3), points (m,3), both in w, and pairs (k,2): rows of cameras and of points they observe."""

    cameras: F64
    points: F64
    pairs: I64

    def near(self) -> I64:
        """The pairs of rays that are not too long."""
        ray = self.points[self.pairs[:, 1]] - self.cameras[self.pairs[:, 0]]
        return self.pairs[np.hypot(ray[:, 0], ray[:, 1]) <= MAX_RAY_M]


def labels_by_height(sparse: SparsePoints) -> tuple[U8, F64]:
    """Labels (m,) of points by their height above the ground that the points themselves show, and its z at each."""
    seen = sparse.near()
    length = _lengths(sparse, seen)
    distance, camera_z = (np.full(len(sparse.points), np.inf) for _ in range(2))
    np.minimum.at(distance, seen[:, 1], length)
    np.minimum.at(camera_z, seen[:, 1], sparse.cameras[seen[:, 0], 2])
    used = np.isfinite(distance)
    ground = np.full(len(sparse.points), np.nan)
    if used.any():
        ground[used] = ground_heights(sparse.points[used], camera_z[used])
    height = sparse.points[:, 2] - ground
    band = _LOW_M + _NOISE_PER_M * np.where(used, distance, 0.0)
    labels = np.zeros(len(height), np.uint8)
    labels[np.abs(height) <= band] = GROUND
    labels[(height > band) & (height <= _HIGH_M)] = OBSTACLE
    return labels, ground


def log_odds_grid(sparse: SparsePoints, cell_m: float) -> GridFile:
    """The grid of kiteline's base before agents made column scans."""
    labels, ground = labels_by_height(sparse)
    seen = _without_overlong(sparse, sparse.near(), labels)
    canvas = _Canvas.around(sparse, seen, cell_m)
    obstacle = np.flatnonzero((labels == OBSTACLE) & np.isin(np.arange(len(labels)), seen[:, 1]))
    c, r = canvas.cells(sparse.points[obstacle]).T
    views = np.bincount(sparse.near()[:, 1], minlength=len(labels))[obstacle]
    np.add.at(canvas.hits, (r, c), views)
    np.minimum.at(canvas.low, (r, c), sparse.points[obstacle, 2])
    np.maximum.at(canvas.high, (r, c), sparse.points[obstacle, 2])
    solid = labels[seen[:, 1]] == OBSTACLE
    canvas.cast(sparse, seen, ground[seen[:, 1]] + np.where(solid, _CLEAR_BELOW_M, _FREE_BELOW_M), solid)
    odds = np.where(canvas.hits > 0, _HIT * canvas.hits + _THROUGH * canvas.through, _FREE * canvas.free)
    state = np.full(odds.shape, UNKNOWN, np.int8)
    state[odds <= _FREE_UP_TO] = FREE
    state[odds >= _OCCUPIED_FROM] = OCCUPIED
    return GridFile(cell_m, (*canvas.corner, 0.0), state)


def binary_grid(sparse: SparsePoints, labels: U8, cell_m: float) -> GridFile:
    """The grid of Segfloor from labelled points (m,): UNLABELLED, GROUND or OBSTACLE."""
    seen = sparse.near()
    seen = seen[labels[seen[:, 1]] != UNLABELLED]
    seen = _without_overlong(sparse, seen, labels)
    canvas = _Canvas.around(sparse, seen, cell_m)
    floor = seen[labels[seen[:, 1]] == GROUND]
    canvas.cast(sparse, floor, np.full(len(floor), np.inf), np.zeros(len(floor), np.bool_))
    state = np.where(canvas.free > 0, FREE, UNKNOWN).astype(np.int8)
    obstacle = np.unique(seen[labels[seen[:, 1]] == OBSTACLE, 1])
    c, r = canvas.cells(sparse.points[obstacle]).T
    state[r, c] = OCCUPIED
    return GridFile(cell_m, (*canvas.corner, 0.0), state)


def _lengths(sparse: SparsePoints, seen: I64) -> F64:
    ray = sparse.points[seen[:, 1]] - sparse.cameras[seen[:, 0]]
    return np.asarray(np.hypot(ray[:, 0], ray[:, 1]))


def _without_overlong(sparse: SparsePoints, seen: I64, labels: U8) -> I64:
    """The pairs without rays to ground points that are outliers in length among their keyframe's."""
    seen = seen[labels[seen[:, 1]] != UNLABELLED]
    if not len(seen):
        return seen
    length, floor = _lengths(sparse, seen), labels[seen[:, 1]] == GROUND
    n = int(seen[:, 0].max()) + 1
    count = np.maximum(np.bincount(seen[floor, 0], minlength=n), 1)
    mean = np.bincount(seen[floor, 0], length[floor], n) / count
    sigma = np.sqrt(np.maximum(np.bincount(seen[floor, 0], length[floor] ** 2, n) / count - mean**2, 0.0))
    upper = mean + (1.0 + 2.0 * _FENCE) * _QUARTILE * sigma
    return np.asarray(seen[~(floor & (length > upper[seen[:, 0]] + 1e-9))], np.int64)


class _Canvas:
    """Counts (rows, columns) in a box around cameras and points. corner: (x, y) of its lower left."""

    def __init__(self, first: I64, shape: tuple[int, int], cell_m: float) -> None:
        self.cell_m, self._first = cell_m, first
        self.corner = (float(first[0] * cell_m), float(first[1] * cell_m))
        self.hits, self.free, self.through = (np.zeros(shape, np.int64) for _ in range(3))
        self.low, self.high = np.full(shape, np.inf), np.full(shape, -np.inf)

    @classmethod
    def around(cls, sparse: SparsePoints, seen: I64, cell_m: float) -> "_Canvas":
        """A canvas that holds all ends of rays."""
        ends = np.concatenate([sparse.cameras[seen[:, 0], :2], sparse.points[seen[:, 1], :2], np.zeros((1, 2))])
        cells = np.floor(ends / cell_m).astype(np.int64)
        first, last = cells.min(0) - 1, cells.max(0) + 1
        return cls(first, (int(last[1] - first[1]) + 1, int(last[0] - first[0]) + 1), cell_m)

    def cells(self, points: F64) -> I64:
        """Column and row (n,2) of points (n, 2 or 3)."""
        return np.asarray(np.floor(points[:, :2] / self.cell_m).astype(np.int64) - self._first, np.int64)

    def cast(self, sparse: SparsePoints, seen: I64, ceiling: F64, short: Bool) -> None:
        """Count the rays of these pairs. ceiling: (k,) z. short: (k,) rays that end before their last cell."""
        z = np.stack([sparse.cameras[seen[:, 0], 2], sparse.points[seen[:, 1], 2]], axis=1)
        cast_rays(
            self.cells(sparse.cameras[seen[:, 0]]), self.cells(sparse.points[seen[:, 1]]), z, ceiling,
            short.astype(np.int64), 0.5 * self.cell_m, self.low, self.high, self.free, self.through,
        )  # fmt: skip

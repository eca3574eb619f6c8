"""Precision and recall of an occupancy grid for path planning, by probabilistic road maps.

After "Segfloor", section 6.1.1: a probabilistic road map (PRM) is drawn on one grid (nodes at random free places, a
minimum distance apart; every straight line over free cells between two nodes is a road) and checked on the other.
Precision is the share of the estimate's roads that are free in the truth, recall the share of the truth's roads that
are free in the estimate; means over draws. Seeded: two grids always give the same numbers.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_lab.grids.files import FREE, GridFile
from kiteline_lab.grids.prm_kernels import roads_free, spaced_places


@dataclass(frozen=True, slots=True)
class GridEvalConfig:
    """How roads are drawn."""

    draws: int = 30  # road maps, as in the paper
    nodes: int = 100  # nodes of each, as in the paper's large scene
    spacing: float = 0.5  # of the distance that nodes had on a square lattice over the free area
    opening_cells: int = 1  # radius of the opening of the free area before scoring; the paper opens all maps
    robot_radius_m: float = (
        0.0  # m by which occupied and unknown cells are dilated first; the paper's roads have no width
    )
    seed: int = 0


@dataclass(frozen=True, slots=True)
class GridScore:
    """Means over the draws in percent (NaN: no roads), and the total numbers of roads."""

    precision: float
    recall: float
    precision_roads: int
    recall_roads: int
    free_est_m2: float
    free_true_m2: float


def free_cells(grid: GridFile, config: GridEvalConfig) -> Bool:
    """Cells that a robot's centre may enter (rows, columns): free, opened, and a radius away from all others."""
    free = (grid.state == FREE).astype(np.uint8)
    if config.opening_cells > 0:
        free = np.asarray(cv2.morphologyEx(free, cv2.MORPH_OPEN, _disc(config.opening_cells)), np.uint8)
    radius = int(np.ceil(config.robot_radius_m / grid.cell_m))
    if radius > 0:
        free = np.asarray(cv2.erode(free, _disc(radius), borderType=cv2.BORDER_CONSTANT, borderValue=0), np.uint8)
    return np.asarray(free > 0)


def _disc(radius: int) -> U8:
    if radius == 1:
        return np.ones((3, 3), np.uint8)
    size = 2 * radius + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


@dataclass(frozen=True, slots=True)
class Roads:
    """One road map. places: (n,2) nodes in m, in the grid they were drawn on. pairs: (p,2) rows of places.

    kept: (p,), whether a road is free in the other grid too.
    """

    places: F64
    pairs: I64
    kept: Bool


def score(
    est: GridFile, true: GridFile, T_true_est: F64 | None = None, config: GridEvalConfig | None = None
) -> GridScore:
    """Precision and recall of a grid. T_true_est: (3,3) planar motion that maps points of est into true."""
    config = config or GridEvalConfig()
    T_true_est = np.eye(3) if T_true_est is None else T_true_est
    free_est, free_true = free_cells(est, config), free_cells(true, config)
    # Affine map from fractional cells (column, row) of the estimate to those of the truth.
    est_to_true = np.asarray(np.linalg.inv(true.T_map_cell) @ T_true_est @ est.T_map_cell)
    precision, precision_roads = _share(free_est, free_true, est_to_true, config, 0)
    recall, recall_roads = _share(free_true, free_est, np.asarray(np.linalg.inv(est_to_true)), config, 1)
    return GridScore(
        precision, recall, precision_roads, recall_roads,
        float(free_est.sum() * est.cell_m**2), float(free_true.sum() * true.cell_m**2),
    )  # fmt: skip


def draw_roads(mine: GridFile, other: GridFile, T_other_mine: F64, config: GridEvalConfig, stream: int = 0) -> Roads:
    """The first of the road maps that `score` draws: on the estimate (stream 0) or on the truth (1)."""
    A = np.asarray(np.linalg.inv(other.T_map_cell) @ T_other_mine @ mine.T_map_cell)
    nodes, pairs, kept = _roads(free_cells(mine, config), free_cells(other, config), A, config, 0, stream)
    return Roads(mine.points(nodes), pairs, kept)


def _share(mine: Bool, other: Bool, A_other_mine: F64, config: GridEvalConfig, stream: int) -> tuple[float, int]:
    """Percent of the roads drawn on `mine` that are free on `other` (mean over draws), and the number of roads."""
    shares, roads = [], 0
    for draw in range(config.draws):
        _, pairs, kept = _roads(mine, other, A_other_mine, config, draw, stream)
        roads += len(pairs)
        if len(pairs):
            shares.append(100.0 * float(kept.mean()))
    return (float(np.mean(shares)) if shares else float("nan")), roads


def _roads(
    mine: Bool, other: Bool, A_other_mine: F64, config: GridEvalConfig, draw: int, stream: int
) -> tuple[F64, I64, Bool]:
    """Nodes (n,2) drawn on `mine`, the pairs (p,2) of them that roads join, and which roads are free on `other`."""
    nodes = draw_nodes(mine, config, np.random.default_rng((config.seed, stream, draw)))
    pairs = np.stack(np.triu_indices(len(nodes), 1), axis=1).astype(np.int64)
    is_road = np.zeros(len(pairs), np.bool_)
    roads_free(mine, nodes, pairs, is_road)
    pairs = pairs[is_road]
    kept = np.zeros(len(pairs), np.bool_)
    roads_free(other, nodes @ A_other_mine[:2, :2].T + A_other_mine[:2, 2], pairs, kept)
    return nodes, pairs, kept


def draw_nodes(free: Bool, config: GridEvalConfig, rng: np.random.Generator) -> F64:
    """Draw nodes (n,2), column and row in cells, at random in free cells and at least the spacing apart."""
    row, column = np.nonzero(free)
    apart = config.spacing * np.sqrt(len(row) / config.nodes)
    places = np.asarray(np.column_stack([column, row]) + 0.5, np.float64)[rng.permutation(len(row))]
    chosen = np.empty((config.nodes, 2))
    return chosen[: spaced_places(places, apart, chosen)]

"""`kiteline grid eval EST.yaml TRUE.yaml`: precision and recall of an occupancy grid for path planning.

After "Segfloor", section 6.1.1: a probabilistic road map (PRM) is drawn on one grid (nodes at random free places, a
minimum distance apart; every straight line over free cells between two nodes is a road) and checked on the other.
Precision is the share of the estimate's roads that are free in the truth, recall the share of the truth's roads that
are free in the estimate; means over draws. Seeded: two grids always give the same numbers.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_core.errors import KitelineError
from kiteline_lab.evaluation.grid_eval_kernels import roads_free

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]
U8 = NDArray[np.uint8]


class GridFileError(KitelineError):
    """A grid that cannot be read; the text says what was expected."""


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
class GridFile:
    """A map_server grid. state: (rows, columns) int8, 0 free, 100 occupied, -1 unknown; row 0 is the lowest y.
    origin: (x, y, yaw) of the lower left corner, m and rad.
    """

    cell_m: float
    origin: tuple[float, float, float]
    state: NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class GridScore:
    """Means over the draws in percent (NaN: no roads), and the total numbers of roads."""

    precision: float
    recall: float
    precision_roads: int
    recall_roads: int
    free_est_m2: float
    free_true_m2: float


def read_grid(path: Path) -> GridFile:
    """Read a map_server YAML file and its PGM image (P2 or P5). Raises GridFileError."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as e:
        raise GridFileError(f"{path}: cannot be read as a grid's YAML file ({e})") from None
    fields = dict(line.split("#")[0].split(":", 1) for line in lines if ":" in line.split("#")[0])
    fields = {k.strip(): v.strip().strip("'\"") for k, v in fields.items()}
    missing = [k for k in ("image", "resolution", "origin") if not fields.get(k)]
    if missing:
        raise GridFileError(f"{path}: no {', '.join(missing)}; expected map_server's image, resolution and origin")
    try:
        cell_m = float(fields["resolution"])
        origin = tuple(float(v) for v in fields["origin"].strip("[]").split(","))
        negate = int(fields.get("negate", "0"))
        occupied, free = float(fields.get("occupied_thresh", "0.65")), float(fields.get("free_thresh", "0.196"))
    except ValueError as e:
        raise GridFileError(f"{path}: {e}; expected numbers as map_server writes them") from None
    if len(origin) != 3 or not cell_m > 0:
        raise GridFileError(f"{path}: expected a positive resolution and an origin [x, y, yaw]")
    shade = read_pgm(path.parent / fields["image"])
    solid = shade if negate else 1.0 - shade
    state = np.full(solid.shape, -1, np.int8)
    state[solid < free] = 0
    state[solid > occupied] = 100
    return GridFile(cell_m, (origin[0], origin[1], origin[2]), np.ascontiguousarray(state[::-1]))


def read_pgm(path: Path) -> F64:
    """A PGM image (P2 or P5, at most 16 bits) as (rows, columns), 0 black to 1 white. Raises GridFileError."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise GridFileError(f"{path}: {e.strerror or e}") from None
    words: list[bytes] = []
    at = 0
    while len(words) < 4 and at < len(data):  # the header: four words, with comments between them
        end = at
        while end < len(data) and not data[end : end + 1].isspace() and data[end : end + 1] != b"#":
            end += 1
        if end > at:
            words.append(data[at:end])
        if data[end : end + 1] == b"#":
            end = data.find(b"\n", end)
            end = len(data) if end < 0 else end
        at = end + 1
    try:
        kind, columns, rows, most = words[0], int(words[1]), int(words[2]), int(words[3])
        if kind not in (b"P2", b"P5") or columns < 1 or rows < 1 or not 0 < most < 65536:
            raise ValueError
        if kind == b"P2":
            values = np.array(data[at:].split(), np.float64)[: rows * columns]
        else:
            values = np.frombuffer(data, ">u2" if most > 255 else "u1", rows * columns, at).astype(np.float64)
        return values.reshape(rows, columns) / most
    except (ValueError, IndexError):
        raise GridFileError(f"{path}: no complete PGM image (P2 or P5)") from None


def free_cells(grid: GridFile, config: GridEvalConfig) -> Bool:
    """Cells that a robot's centre may enter (rows, columns): free, opened, and a radius away from all others."""
    free = (grid.state == 0).astype(np.uint8)
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


def score(
    est: GridFile, true: GridFile, T_true_est: F64 | None = None, config: GridEvalConfig | None = None
) -> GridScore:
    """Precision and recall of a grid. T_true_est: (3,3) planar motion that maps points of est into true."""
    config = config or GridEvalConfig()
    T_true_est = np.eye(3) if T_true_est is None else T_true_est
    free_est, free_true = free_cells(est, config), free_cells(true, config)
    # Affine map from fractional cells (column, row) of the estimate to those of the truth.
    est_to_true: F64 = np.linalg.inv(_T_map_cell(true)) @ T_true_est @ _T_map_cell(est)
    precision, precision_roads = _share(free_est, free_true, est_to_true, config, 0)
    recall, recall_roads = _share(free_true, free_est, np.asarray(np.linalg.inv(est_to_true), np.float64), config, 1)
    return GridScore(
        precision, recall, precision_roads, recall_roads,
        float(free_est.sum() * est.cell_m**2), float(free_true.sum() * true.cell_m**2),
    )  # fmt: skip


def _T_map_cell(grid: GridFile) -> F64:
    x, y, yaw = grid.origin
    c, s = np.cos(yaw) * grid.cell_m, np.sin(yaw) * grid.cell_m
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def _share(mine: Bool, other: Bool, A_other_mine: F64, config: GridEvalConfig, stream: int) -> tuple[float, int]:
    """Percent of the roads drawn on `mine` that are free on `other` (mean over draws), and the number of roads."""
    shares, roads = [], 0
    for draw in range(config.draws):
        rng = np.random.default_rng((config.seed, stream, draw))
        nodes = draw_nodes(mine, config, rng)
        pairs = np.stack(np.triu_indices(len(nodes), 1), axis=1).astype(np.int64)
        is_road = np.zeros(len(pairs), np.bool_)
        roads_free(mine, nodes, pairs, is_road)
        pairs = pairs[is_road]
        kept = np.zeros(len(pairs), np.bool_)
        roads_free(other, nodes @ A_other_mine[:2, :2].T + A_other_mine[:2, 2], pairs, kept)
        roads += len(pairs)
        if len(pairs):
            shares.append(100.0 * float(kept.mean()))
    return (float(np.mean(shares)) if shares else float("nan")), roads


def draw_nodes(free: Bool, config: GridEvalConfig, rng: np.random.Generator) -> F64:
    """Draw nodes (n,2), column and row in cells, at random in free cells and at least the spacing apart."""
    row, column = np.nonzero(free)
    apart = config.spacing * np.sqrt(len(row) / config.nodes)
    chosen = np.zeros((0, 2))
    for i in rng.permutation(len(row)):
        place = np.array([column[i] + 0.5, row[i] + 0.5])
        if not len(chosen) or ((chosen - place) ** 2).sum(axis=1).min() >= apart**2:
            chosen = np.concatenate([chosen, place[None]])
            if len(chosen) == config.nodes:
                break
    return chosen


def planar(x_m: float, y_m: float, yaw_deg: float) -> F64:
    """(3,3) planar motion."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[c, -s, x_m], [s, c, y_m], [0.0, 0.0, 1.0]])


def main(argv: list[str]) -> int:
    """Run `kiteline grid eval`, which prints one JSON object; the exit status. Raises GridFileError."""
    parser = argparse.ArgumentParser(prog="kiteline grid eval", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("est", type=Path, metavar="EST.yaml")
    parser.add_argument("true", type=Path, metavar="TRUE.yaml")
    parser.add_argument(
        "--transform", type=float, nargs=3, default=(0.0, 0.0, 0.0), metavar=("X", "Y", "YAW"),
        help="motion that maps EST onto TRUE: metres and degrees",
    )  # fmt: skip
    default = GridEvalConfig()
    parser.add_argument("--draws", type=int, default=default.draws)
    parser.add_argument("--nodes", type=int, default=default.nodes)
    parser.add_argument("--opening", type=int, default=default.opening_cells, metavar="CELLS")
    parser.add_argument("--robot-radius", type=float, default=default.robot_radius_m, metavar="M")
    parser.add_argument("--seed", type=int, default=default.seed)
    args = parser.parse_args(argv)
    if args.draws < 1 or args.nodes < 2 or args.opening < 0 or args.robot_radius < 0:
        parser.error("expected at least 1 draw, 2 nodes, and no negative opening or radius")
    config = GridEvalConfig(args.draws, args.nodes, default.spacing, args.opening, args.robot_radius, args.seed)
    found = score(read_grid(args.est), read_grid(args.true), planar(*args.transform), config)
    result = {
        "precision_percent": _rounded(found.precision),
        "recall_percent": _rounded(found.recall),
        "roads": {"estimate": found.precision_roads, "truth": found.recall_roads},
        "free_m2": {"estimate": round(found.free_est_m2, 3), "truth": round(found.free_true_m2, 3)},
        "draws": config.draws,
        "nodes": config.nodes,
        "opening_cells": config.opening_cells,
        "robot_radius_m": config.robot_radius_m,
        "seed": config.seed,
    }
    print(json.dumps(result, indent=2))
    return 0


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 3)

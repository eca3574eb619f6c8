"""`kiteline grid path GRID.yaml FROM TO --radius R`: the shortest way on which a vehicle touches nothing."""

import argparse
import json
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from kiteline_core.arrays import F64, Bool
from kiteline_core.errors import KitelineError
from kiteline_core.wording import counted
from kiteline_lab.grids.files import FREE, OCCUPIED, UNKNOWN, GridFile, read_grid
from kiteline_lab.grids.path_kernels import search
from kiteline_lab.grids.picture import draw_path
from kiteline_lab.grids.prm_kernels import roads_free

_FARTHEST_M = 1e9  # beyond, numbers of cells would not be exact


class GridPathError(KitelineError):
    """There is no path; the text says why."""


@dataclass(frozen=True, slots=True)
class GridPath:
    """A path. places: (n,2) corners in m, in the grid's frame. clearance_m: least distance to what blocks the way."""

    places: F64
    length_m: float
    clearance_m: float


def find_path(grid: GridFile, start: F64, goal: F64, radius_m: float, *, through_unknown: bool = False) -> GridPath:
    """The shortest path between two points (2,) in m for a vehicle of this radius. Raises GridPathError.

    A* over the cells whose centres are clear, then corners are cut where the straight line is clear too. Cells outside
    of the grid block the way, unknown ones unless `through_unknown`.
    """
    blocked = grid.state == OCCUPIED if through_unknown else grid.state != FREE
    clearance = clearance_m(blocked, grid.cell_m)
    clear = ~blocked & (clearance >= radius_m)
    ends = []
    for name, place in (("start", start), ("goal", goal)):
        column, row = np.floor(grid.cells(place[None])[0]).astype(np.int64)
        fault = _fault(grid, place, (int(row), int(column)), clearance, radius_m, through_unknown=through_unknown)
        if fault:
            raise GridPathError(f"the {name} {_text(place)} {fault}; {_nearest_place(grid, clear, place)}")
        ends.append(int(row * grid.state.shape[1] + column))
    n = clear.size
    cost, before = np.full(n, np.inf), np.full(n, -1, np.int64)
    found = search(
        clear, ends[0], ends[1], cost, before, np.zeros(n, np.bool_), np.empty(8 * n + 8), np.empty(8 * n + 8, np.int64)
    )
    if not found:
        way = "" if through_unknown else " over known cells; --through-unknown lets the path cross others"
        raise GridPathError(f"no path of radius {radius_m:g} m from {_text(start)} to {_text(goal)}{way}")
    cells = [ends[1]]
    while before[cells[-1]] >= 0:
        cells.append(int(before[cells[-1]]))
    rows, columns = np.divmod(np.array(cells[::-1]), grid.state.shape[1])
    corners = _shortened(clear, np.column_stack([columns, rows]) + 0.5)
    places = grid.points(corners)
    length = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    along = np.concatenate([np.linspace(a, b, 64) for a, b in pairwise(corners)] or [corners])
    c, r = np.floor(along).astype(np.int64).T
    return GridPath(places, length, float(clearance[r, c].min()))


def clearance_m(blocked: Bool, cell_m: float) -> F64:
    """Distance in m (rows, columns) of each cell's centre to the nearest blocked cell, or to the outside; 0 in one.

    The half diagonal of the blocked cell is taken off: it is a lower bound.
    """
    padded = np.pad(~blocked, 1, constant_values=False).astype(np.uint8)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return np.asarray(np.maximum(distance - np.sqrt(0.5), 0.0) * cell_m, np.float64)


def _fault(
    grid: GridFile, place: F64, cell: tuple[int, int], clearance: F64, radius_m: float, *, through_unknown: bool
) -> str:
    """Why the vehicle cannot be at an end of the path; empty if it can."""
    rows, columns = grid.state.shape
    if not (0 <= cell[0] < rows and 0 <= cell[1] < columns):
        corners = grid.points(np.array([[0.0, 0.0], [columns, rows]]))
        return f"lies outside of the grid, {_text(corners[0])} to {_text(corners[1])}"
    if grid.state[cell] == OCCUPIED:
        return "lies in an obstacle"
    if grid.state[cell] == UNKNOWN and not through_unknown:
        return "lies in an unknown cell; --through-unknown allows that"
    if clearance[cell] < radius_m:
        return f"is {clearance[cell]:.2f} m from what blocks the way: too near for a radius of {radius_m:g} m"
    return ""


def _nearest_place(grid: GridFile, clear: Bool, place: F64) -> str:
    """The nearest place where the vehicle can be, in words."""
    row, column = np.nonzero(clear)
    if not len(row):
        return "nowhere in this grid is room for the vehicle: a smaller --radius, or a longer flight"
    places = grid.points(np.column_stack([column + 0.5, row + 0.5]))
    nearest = places[int(np.argmin(np.sum((places - place) ** 2, axis=1)))]
    return f"the nearest place with room is {_text(np.round(nearest, 2))}"


def _text(place: F64) -> str:
    return f"{place[0]:g},{place[1]:g}"


def _shortened(clear: Bool, corners: F64) -> F64:
    """The path (n,2) without the corners that straight lines over clear cells can pass by."""
    kept = [0]
    while kept[-1] < len(corners) - 1:
        here = kept[-1]
        pairs = np.array([[here, k] for k in range(here + 1, len(corners))], np.int64)
        straight = np.zeros(len(pairs), np.bool_)
        roads_free(clear, corners, pairs, straight)
        kept.append(here + 1 + int(np.flatnonzero(straight)[-1]) if straight.any() else here + 1)
    return corners[kept]


def _place(text: str) -> F64:
    try:
        x, y = (float(v) for v in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: expected X,Y in m") from None
    if not max(abs(x), abs(y)) < _FARTHEST_M:
        raise argparse.ArgumentTypeError(f"{text!r}: expected X,Y in m, below {_FARTHEST_M:g}")
    return np.array([x, y])


def main(argv: list[str]) -> int:
    """Run `kiteline grid path`; the exit status. Raises GridFileError and GridPathError."""
    parser = argparse.ArgumentParser(
        prog="kiteline grid path", description="The shortest path on which a vehicle touches nothing.",
    )  # fmt: skip
    parser.add_argument("grid", type=Path, metavar="GRID.yaml")
    parser.add_argument("start", type=_place, metavar="FROM", help="X,Y in m, in the grid's frame")
    parser.add_argument("goal", type=_place, metavar="TO")
    parser.add_argument(
        "--radius", type=float, default=0.3, metavar="R", help="of the vehicle in m (default %(default)s)"
    )
    parser.add_argument("--through-unknown", action="store_true", help="unknown cells do not block the way")
    parser.add_argument("--plot", type=Path, metavar="F.png", help="draw grid and path, or its ends if there is none")
    parser.add_argument("--json", action="store_true", help="print length, clearance and corners as JSON")
    # A place with a negative x would be taken for an option.
    args = parser.parse_args([f" {a}" if re.match(r"-[\d.]", a) and "," in a else a for a in argv])
    if not args.radius >= 0.0:
        parser.error("expected a radius that is not negative")
    grid = read_grid(args.grid)
    try:
        found = find_path(grid, args.start, args.goal, args.radius, through_unknown=args.through_unknown)
    except GridPathError:
        if args.plot is not None:  # it shows why
            draw_path(args.plot, grid, np.array([args.start, args.goal]), args.radius, found=False)
        raise
    if args.plot is not None:
        draw_path(args.plot, grid, found.places, args.radius)
    if args.json:
        corners = [[round(float(v), 4) for v in place] for place in found.places]
        print(
            json.dumps(
                {"length_m": round(found.length_m, 4), "clearance_m": round(found.clearance_m, 4), "corners_m": corners}
            )
        )
    else:
        parts = counted(len(found.places) - 1, "straight part")
        print(f"{found.length_m:.2f} m, {parts}, {found.clearance_m:.2f} m of room")
    return 0

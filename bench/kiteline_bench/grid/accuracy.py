"""Precision and recall of the base's grid, beside those of the reference methods, and objects that must be in it."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from kiteline_bench.grid.flown import FlownGrid, fly_grid, picture_path
from kiteline_bench.grid.ideal import by_centres, by_whole_cells
from kiteline_bench.grid.places import Place, all_places
from kiteline_bench.grid.sparse import binary_grid, labels_by_height, log_odds_grid
from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.recording import load
from kiteline_core.arrays import F64, Bool
from kiteline_lab.grids.files import OCCUPIED, GridFile
from kiteline_lab.grids.picture import draw_comparison, resampled
from kiteline_lab.grids.prm import GridScore, score

_PRECISION, _RECALL = 99.5, 97.0  # percent
_REFERENCE_CELLS_M = (0.05, 0.01)
_NEAR_M = 0.10  # of a true cell of an object; two cells: what is drawn there is that object
_LEAST_SEEN = 4  # cells of an object that have to be seen before it must be in the grid
_SHARE = 0.5  # of these cells that must have an obstacle near


def run(bench: Bench) -> list[Bar]:
    """Bars on all places."""
    bars, rows = [], []
    for place in all_places(bench):
        flight = fly_grid(bench, place.name, load(place.recording))
        found, everything = judged(place, flight.grid, flight.T_plane)
        draw_comparison(picture_path(bench, place.name), flight.grid, place.seen, flight.T_plane)
        bars += [
            _at_least(f"{place.name}: precision", found.precision, _PRECISION),
            _at_least(f"{place.name}: recall", found.recall, _RECALL),
            *objects_present(place, flight.grid, flight.T_plane),
        ]
        rows.append(_row(place, "kiteline", flight.grid, found, everything))
        rows += limits(place, flight)
        rows += references(place, flight)
        bench.say(
            f"  keyframes {1000 * flight.keyframe_m:.1f} mm; "
            + "; ".join(" ".join(map(str, r[1:5])) for r in rows[-7:])
        )
    columns = ("place", "method", "cell m", "precision %", "recall %", "precision, unseen cells free too", "free m2")
    table(bench, "Road maps of 100 nodes, 30 draws", columns, rows)
    return bars


def judged(place: Place, grid: GridFile, T_true_est: F64) -> tuple[GridScore, GridScore]:
    """The score by what was seen, and by all that is true.

    Recall is that of cells within range. What is free beyond, and was in sight there, is no error.
    """
    found, in_sight, everything = (score(grid, true, T_true_est) for true in (place.seen, place.sight, place.true))
    return replace(found, precision=in_sight.precision), everything


def limits(place: Place, flight: FlownGrid) -> list[Sequence[object]]:
    """Rows of grids drawn from the truth on the cells of the flown one: what cells alone cost, without noise."""
    rows = []
    for name, draw in (
        ("the truth at the cells' centres", by_centres),
        ("the truth, cells free as a whole", by_whole_cells),
    ):
        grid = draw(place.sight, flight.grid, flight.T_plane)
        rows.append(_row(place, name, grid, *judged(place, grid, flight.T_plane)))
    return rows


def references(place: Place, flight: FlownGrid) -> list[Sequence[object]]:
    """Rows of the methods that draw sparse points."""
    sparse, rows = flight.sparse, []
    labels = labels_by_height(sparse)[0]
    for cell_m in _REFERENCE_CELLS_M:
        for name, grid in (
            ("sparse points, log-odds", log_odds_grid(sparse, cell_m)),
            ("sparse points, binary layers (Segfloor)", binary_grid(sparse, labels, cell_m)),
        ):
            found, everything = judged(place, grid, flight.T_plane)
            rows.append(_row(place, name, grid, found, everything))
    return rows


def objects_present(place: Place, grid: GridFile, T_true_est: F64) -> list[Bar]:
    """A bar for each kind of object: how many of those that were seen are in the grid."""
    if place.world is None or not place.world.objects:
        return []
    seen = (place.seen.state == OCCUPIED).astype(np.uint8)
    drawn = (resampled(grid, place.seen, T_true_est) == OCCUPIED).astype(np.uint8)
    far = cv2.distanceTransform(1 - drawn, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * grid.cell_m
    kinds: dict[str, list[bool]] = {}
    for kind, first, last in place.world.objects:
        cells = np.zeros(seen.shape, np.bool_)
        for box in place.world.boxes[first:last]:
            cells |= _covered(place.seen, box)
        cells &= seen > 0
        if np.count_nonzero(cells) >= _LEAST_SEEN:
            kinds.setdefault(kind, []).append(bool((far[cells] <= _NEAR_M).mean() >= _SHARE))
    return [
        Bar(f"{place.name}: each {kind} that was seen is in the grid", f"{len(there)}", f"{sum(there)}", all(there))
        for kind, there in kinds.items()
    ]


def _covered(grid: GridFile, box: F64) -> Bool:
    """Cells (rows, columns) whose centres lie within half a cell of a box (8,), seen from above."""
    r, c = np.indices(grid.state.shape)
    at = np.stack([c + 0.5, r + 0.5], -1) @ grid.T_map_cell[:2, :2].T + grid.T_map_cell[:2, 2] - box[:2]
    x, y = box[6] * at[..., 0] + box[7] * at[..., 1], box[6] * at[..., 1] - box[7] * at[..., 0]
    half = 0.5 * grid.cell_m
    return np.asarray((np.abs(x) < box[3] + half) & (np.abs(y) < box[4] + half))


def _row(place: Place, method: str, grid: GridFile, found: GridScore, everything: GridScore) -> Sequence[object]:
    return (
        place.name, method, grid.cell_m, f"{found.precision:.2f}", f"{found.recall:.2f}", f"{everything.precision:.2f}",
        f"{found.free_est_m2:.1f} of {found.free_true_m2:.1f}",
    )  # fmt: skip


def _at_least(name: str, percent: float, limit: float) -> Bar:
    return Bar(name, f">= {limit:g} %", f"{percent:.2f} %", bool(percent >= limit))

"""Pictures of occupancy grids: estimate, truth and difference side by side; a path."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from kiteline_core.arrays import F64, I8, U8
from kiteline_lab.grids.files import FREE, OCCUPIED, UNKNOWN, GridFile, GridFileError
from kiteline_lab.grids.prm import GridEvalConfig, Roads, draw_roads
from kiteline_lab.outputs.out_file import write_whole

_SHADES = {FREE: (255, 255, 255), OCCUPIED: (0, 0, 0), UNKNOWN: (190, 190, 190)}  # BGR, as all colours here
_RED, _ORANGE, _BLUE, _LIGHT_BLUE, _GREEN = (40, 40, 215), (60, 165, 245), (190, 90, 20), (235, 190, 130), (60, 140, 30)
_DIFFERENCES = (
    ("free in both", (255, 255, 255), FREE, (FREE,)),
    ("not free in both", (120, 120, 120), None, ()),
    ("free, truly occupied", _RED, FREE, (OCCUPIED,)),
    ("free, truly unseen", _ORANGE, FREE, (UNKNOWN,)),
    ("occupied, truly free", _BLUE, OCCUPIED, (FREE,)),
    ("unknown, truly free", _LIGHT_BLUE, UNKNOWN, (FREE,)),
)
_LEAST_PX, _MOST_PX = 480, 1200  # longer side of a panel
_BAR_PX = 26


def draw_comparison(
    path: Path, est: GridFile, true: GridFile, T_true_est: F64, config: GridEvalConfig | None = None
) -> None:
    """Write a PNG of estimate, truth and difference, in the cells of the truth.

    Of the first road map those roads are drawn in red that are free in one grid and not in the other.
    """
    config = config or GridEvalConfig()
    there = resampled(est, true, T_true_est)
    rows, columns = np.nonzero((there != UNKNOWN) | (true.state != UNKNOWN))
    if not len(rows):
        raise GridFileError("nothing to draw: both grids are unknown everywhere")
    window = slice(max(0, rows.min() - 3), rows.max() + 4), slice(max(0, columns.min() - 3), columns.max() + 4)
    a, b = there[window], true.state[window]
    difference = np.empty((*a.shape, 3), np.uint8)
    difference[:] = _DIFFERENCES[1][1]
    for _, colour, mine, others in _DIFFERENCES:
        if mine is not None:
            difference[(a == mine) & np.isin(b, others)] = colour
    side = max(a.shape)
    scale = max(1, round(_LEAST_PX / side)) if side < _MOST_PX else _MOST_PX / side
    panels = [_shown(image, scale) for image in (shaded(a), shaded(b), difference)]
    corner = np.array([window[1].start, window[0].start])
    for panel, roads, T in (
        (panels[0], draw_roads(est, true, T_true_est, config), T_true_est),
        (
            panels[1],
            draw_roads(true, est, np.asarray(np.linalg.inv(T_true_est), np.float64), config, stream=1),
            np.eye(3),
        ),
    ):
        _draw_roads(panel, roads, np.linalg.inv(true.T_map_cell) @ T, corner, scale)
    names = ("estimate", "truth", "difference")
    _write(path, _legend(np.hstack([_titled(p, n) for p, n in zip(panels, names, strict=True)])))


def draw_path(path: Path, grid: GridFile, places: F64, radius_m: float, *, found: bool = True) -> None:
    """Write a PNG of a grid with a path of places (n,2) in m, and the vehicle's radius at both ends.

    found: False: places are the ends of a path that does not exist.
    """
    scale = max(1, round(_LEAST_PX / max(grid.state.shape))) if max(grid.state.shape) < _MOST_PX else 1.0
    image = _shown(shaded(grid.state), scale)
    cells = grid.cells(places)
    pixels = [_pixel(image, cell, np.zeros(2), scale) for cell in cells]
    for a, b in pairwise(pixels if found else []):
        cv2.line(image, a, b, _RED, 2, cv2.LINE_AA)
    for at, colour in ((pixels[0], _GREEN), (pixels[-1], _RED)):
        cv2.circle(image, at, max(3, round(radius_m / grid.cell_m * scale)), colour, 2, cv2.LINE_AA)
    _write(path, image)


def resampled(est: GridFile, true: GridFile, T_true_est: F64) -> I8:
    """The states of est at the centres of the cells of true; unknown outside of it."""
    rows, columns = true.state.shape
    r, c = np.indices((rows, columns))
    A = np.linalg.inv(est.T_map_cell) @ np.linalg.inv(T_true_est) @ true.T_map_cell
    at = np.stack([c + 0.5, r + 0.5], -1) @ A[:2, :2].T + A[:2, 2]
    column, row = np.floor(at).astype(np.int64).transpose(2, 0, 1)
    inside = (column >= 0) & (row >= 0) & (column < est.state.shape[1]) & (row < est.state.shape[0])
    out = np.full((rows, columns), UNKNOWN, np.int8)
    out[inside] = est.state[row[inside], column[inside]]
    return out


def shaded(state: I8) -> U8:
    """A grid (rows, columns) as an image (rows, columns, 3), row 0 still the lowest y."""
    out = np.empty((*state.shape, 3), np.uint8)
    for value, colour in _SHADES.items():
        out[state == value] = colour
    return out


def _shown(image: U8, scale: float) -> U8:
    """The image enlarged, with the highest y first."""
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    return np.asarray(cv2.resize(image[::-1], size, interpolation=cv2.INTER_NEAREST), np.uint8)


def _pixel(image: U8, cell: F64, corner: F64, scale: float) -> tuple[int, int]:
    x, y = (cell - corner) * scale
    return round(float(x)), round(float(image.shape[0] - 1 - y))


def _draw_roads(panel: U8, roads: Roads, T_cell_map: F64, corner: F64, scale: float) -> None:
    places = roads.places @ T_cell_map[:2, :2].T + T_cell_map[:2, 2]
    for a, b in roads.pairs[~roads.kept]:
        cv2.line(panel, _pixel(panel, places[a], corner, scale), _pixel(panel, places[b], corner, scale), _RED, 1)


def _titled(panel: U8, name: str) -> U8:
    out = cv2.copyMakeBorder(panel, _BAR_PX, 4, 4, 4, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    cv2.putText(out, name, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (60, 60, 60), 1, cv2.LINE_AA)
    return np.asarray(out, np.uint8)


def _legend(image: U8) -> U8:
    """The image with the colours of the difference named below."""
    steps = [40 + 8 * len(name) for name, *_ in _DIFFERENCES]
    wider = max(0, 6 + sum(steps) - image.shape[1])  # than narrow panels, so that no name is cut off
    out = cv2.copyMakeBorder(image, 0, _BAR_PX, 0, wider, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    x, y = 6, out.shape[0] - 8
    for (name, colour, _, _), step in zip(_DIFFERENCES, steps, strict=True):
        cv2.rectangle(out, (x, y - 12), (x + 14, y + 2), colour, -1)
        cv2.rectangle(out, (x, y - 12), (x + 14, y + 2), (60, 60, 60), 1)
        cv2.putText(out, name, (x + 20, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (60, 60, 60), 1, cv2.LINE_AA)
        x += step
    return np.asarray(out, np.uint8)


def _write(path: Path, image: U8) -> None:
    ok, data = cv2.imencode(".png", image)
    assert ok
    try:
        write_whole(path, data.tobytes())
    except OSError as e:
        raise GridFileError(f"{path}: {e.strerror or e}") from None

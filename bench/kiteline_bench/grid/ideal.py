"""The truth itself as a grid on the cells of a flown one: what precision and recall lose to the cells alone."""

import numpy as np

from kiteline_core.arrays import F64, I8
from kiteline_lab.grids.files import FREE, OCCUPIED, UNKNOWN, GridFile
from kiteline_lab.grids.picture import resampled

_PLACES = (-0.45, 0.0, 0.45)  # in a cell's width and height, that are looked up of a whole cell


def by_centres(true: GridFile, cells: GridFile, T_true_est: F64) -> GridFile:
    """The true state at the centre of each cell. T_true_est: (3,3), maps points of `cells` into `true`."""
    return GridFile(cells.cell_m, cells.origin, _looked_up(true, cells, T_true_est, 0.0, 0.0))


def by_whole_cells(true: GridFile, cells: GridFile, T_true_est: F64) -> GridFile:
    """Free where a cell lies in free space as a whole, occupied where any of it is."""
    states = np.stack([_looked_up(true, cells, T_true_est, x, y) for x in _PLACES for y in _PLACES])
    occupied = np.where((states == OCCUPIED).any(0), OCCUPIED, UNKNOWN)
    return GridFile(cells.cell_m, cells.origin, np.where((states == FREE).all(0), FREE, occupied).astype(np.int8))


def _looked_up(true: GridFile, cells: GridFile, T_true_est: F64, x: float, y: float) -> I8:
    """True states (rows, columns) beside the cells' centres, by parts of a cell."""
    beside = np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])
    T_cells = cells.T_map_cell
    return resampled(true, cells, np.linalg.inv(T_true_est @ T_cells @ beside @ np.linalg.inv(T_cells)))

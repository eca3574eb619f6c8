"""Scans of a room that is known, for tests of the grid."""

import numpy as np

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid_view import dense
from kiteline_basestation.grid.kept_scan import KeptScan, keep
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_core.arrays import F64, I8
from kiteline_core.ground.column_scan import ColumnScan
from tests.basestation.flat_rooms import ROOM, camera, circle, scan_of

CONFIG = GridConfig()
BF = 100.0  # px m


def kept(scan: ColumnScan, config: GridConfig = CONFIG) -> KeptScan:
    found = keep(config, scan, BF)
    assert found is not None
    return found


def flight(n: int = 40, seed: int = 0) -> list[tuple[KeptScan, tuple[float, float, float]]]:
    rng = np.random.default_rng(seed)
    return [(kept(scan_of(ROOM, *pose, noise=0.003, rng=rng)), pose) for pose in circle(n)]


def drawn(scans: list[tuple[KeptScan, tuple[float, float, float]]], config: GridConfig = CONFIG) -> ScanGrid:
    grid = ScanGrid(config)
    for k, (scan, pose) in enumerate(scans):
        grid.put(k, scan, camera(*pose))
    return grid


def at(grid: ScanGrid, x: F64 | float, y: F64 | float) -> I8:
    cells, corner, cell = dense(grid, 0)
    rows = np.floor((np.asarray(y) - corner[1]) / cell).astype(int)
    return np.asarray(cells[rows, np.floor((np.asarray(x) - corner[0]) / cell).astype(int)])

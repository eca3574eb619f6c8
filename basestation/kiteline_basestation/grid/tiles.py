"""The grid's tiles as records for the link."""

from __future__ import annotations

import numpy as np

from kiteline_basestation.grid.grid import TILE, UNKNOWN, Grid
from kiteline_codec.schema import GridTile


def tiles(grid: Grid, since: int = 0) -> tuple[GridTile, ...]:
    """The tiles that changed after revision `since` (0: all), in order of row, column; vanished ones as unknown.

    Remember `grid.revision` and hand it in as `since` the next time.
    """
    held = {(int(r), int(c)): i for i, (c, r) in enumerate(grid.map.tiles)}
    unknown = np.full((TILE, TILE), UNKNOWN, np.int8)
    return tuple(
        GridTile(column, row, grid.map.cell_m, grid.map.cells[held[row, column]] if (row, column) in held else unknown)
        for (row, column), revision in sorted(grid.changed.items())
        if revision > since
    )

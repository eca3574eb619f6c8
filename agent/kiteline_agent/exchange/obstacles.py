"""Distances to obstacles around the vehicle, from the base's grid: for a flight controller that avoids them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.schema import GridTile
from kiteline_codec.schema.base.grid_tile import FREE, TILE_CELLS, UNKNOWN

F64 = NDArray[np.float64]

SECTORS = 72  # of 5 degrees
REACH_M = 10.0  # m; farther cells do not count
_STEP_M = (0.02, 0.5)  # m; between points of a ray, whatever size of cells a tile names
_RAYS = 3  # in each sector: at 10 m a sector is 0.9 m wide


def obstacle_distances(tiles: Mapping[tuple[int, int], GridTile], T_w_f: F64) -> F64 | None:
    """Distance (SECTORS,) in m to the nearest obstacle in each sector, the first one ahead, clockwise from above.

    inf: all cells up to REACH_M are free. nan: not all are known. T_w_f: (4,4) vehicle (forward, right, down) in w.
    None without a tile, or with the nose up or down.
    """
    if not tiles or float(np.hypot(*T_w_f[:2, 0])) < 0.3:
        return None
    cell_m = next(iter(tiles.values())).cell_m
    heading = np.arctan2(T_w_f[1, 0], T_w_f[0, 0])
    offsets = (np.arange(_RAYS) - 0.5 * (_RAYS - 1)) / _RAYS
    angles = heading - (np.arange(SECTORS)[:, None] + offsets) * (2 * np.pi / SECTORS)  # (s, r)
    step_m = float(np.clip(0.5 * cell_m, *_STEP_M))
    along = np.arange(step_m, REACH_M, step_m)
    directions = np.stack([np.cos(angles), np.sin(angles)], -1)
    points = T_w_f[:2, 3] + along[:, None] * directions[:, :, None, :]  # (s, r, d, 2)
    found = _cells(tiles, np.floor(points / cell_m).astype(np.int64))
    solid = found > FREE
    nearest = np.where(solid.any(2), along[solid.argmax(2)], np.inf)  # (s, r)
    known = np.isfinite(nearest) | (found >= FREE).all(2)
    out = nearest.min(1)
    return np.where(np.isfinite(out) | known.all(1), out, np.nan)


def _cells(tiles: Mapping[tuple[int, int], GridTile], cells: NDArray[np.int64]) -> NDArray[np.int8]:
    """Values of cells (…, 2), column and row in w, as tiles have them."""
    out = np.full(cells.shape[:-1], UNKNOWN, np.int8)
    places, within = cells // TILE_CELLS, cells % TILE_CELLS
    low, high = places.reshape(-1, 2).min(0), places.reshape(-1, 2).max(0)
    for (column, row), tile in tiles.items():
        if low[0] <= column <= high[0] and low[1] <= row <= high[1]:
            inside = (places[..., 0] == column) & (places[..., 1] == row)
            out[inside] = tile.cells[within[inside][:, 1], within[inside][:, 0]]
    return out

"""The map's files, as bytes by file name. Pure."""

from __future__ import annotations

import numpy as np

from kiteline_basestation.grid.grid import build, to_pgm, to_yaml
from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.runtime.map_formats import map_ply


def map_files(mapper: Mapper) -> dict[str, bytes]:
    """map.ply, grid.pgm and grid.yaml of the map as it stands."""
    placed = placed_map(mapper.map, mapper.placements)
    grid = build(mapper.config.grid, placed.positions, placed.points, placed.rays)
    views = np.bincount(placed.observations[:, 1], minlength=len(placed.points)).astype(np.int64)
    return {
        "map.ply": map_ply(placed.points, grid.labels, views),
        "grid.pgm": to_pgm(grid),
        "grid.yaml": to_yaml(grid, "grid.pgm"),
    }

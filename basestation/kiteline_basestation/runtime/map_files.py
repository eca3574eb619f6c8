"""The map's files, as bytes by file name. Pure."""

import numpy as np

from kiteline_basestation.grid.grid_view import grid_files
from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.runtime.map_formats import map_ply


def map_files(mapper: Mapper) -> dict[str, bytes]:
    """map.ply, grid.pgm and grid.yaml of the map as it stands, and the grids of other storeys."""
    placed = placed_map(mapper.map, mapper.placements)
    labels = mapper.labels(mapper.map.find_landmarks(placed.landmark_ids))
    views = np.bincount(placed.observations[:, 1], minlength=len(placed.points)).astype(np.int64)
    metric = bool(placed.metric.any()) or not len(placed.metric)
    return {"map.ply": map_ply(placed.points, labels, views, metric=metric), **grid_files(mapper.settled_grid())}

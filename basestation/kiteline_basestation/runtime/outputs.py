"""What the base leaves of its map, as bytes by file name; and where its keyframes are. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.grid.grid import build, to_pgm, to_yaml
from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.runtime.export import map_ply
from kiteline_core.ids import KeyframeId

F64 = NDArray[np.float64]


def keyframe_poses(mapper: Mapper) -> dict[KeyframeId, F64]:
    """S_w_k (4,4) of every keyframe of a placed submap that has a pose: T_w_k, with the scale of its submap in w."""
    poses: dict[KeyframeId, F64] = {}
    for submap, S_w_m in sorted(mapper.placements.items()):
        for keyframe in mapper.map.submaps.get(submap, []):
            pose = mapper.map.pose(keyframe)
            if pose is not None:
                poses[keyframe] = S_w_m @ pose
    return poses


def map_files(mapper: Mapper) -> dict[str, bytes]:
    """map.ply, grid.pgm and grid.yaml of the map as it stands."""
    view = placed_map(mapper.map, mapper.placements)
    grid = build(mapper.config.grid, view.positions, view.points, view.rays)
    seen = np.bincount(view.observations[:, 1], minlength=len(view.points)).astype(np.int64)
    return {
        "map.ply": map_ply(view.points, grid.labels, seen),
        "grid.pgm": to_pgm(grid),
        "grid.yaml": to_yaml(grid, "grid.pgm"),
    }


def counts(mapper: Mapper) -> dict[str, int]:
    """The base's part of report.json that the map itself tells."""
    summary = mapper.summary()
    names = (
        "keyframes",
        "loops",
        "merges",
        "found",
        "triangulated",
        "culled",
        "keyframes_culled",
        "bundles",
        "grids",
        "refused_records",
    )
    return {"map_points": _whole(summary["points"]), **{name: _whole(summary[name]) for name in names}}


def _whole(value: object) -> int:
    assert isinstance(value, int)
    return value

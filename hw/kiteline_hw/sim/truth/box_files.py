"""Worlds given as a list of solid boxes: a CSV file beside a recording that someone else rendered."""

from pathlib import Path

import numpy as np

from kiteline_hw.ports import SourceError
from kiteline_hw.sim.world.textures import TexturePool
from kiteline_hw.sim.world.world import NO_GROUND, World

_ROWS = "rows of 7 numbers: centre x y z, positive half-extents x y z, yaw"


def read_boxes(path: Path) -> World:
    """The world of a CSV file: centre x y z, half-extents x y z in m and yaw in rad of each box; first the room itself.

    It has no textures, so nothing can be rendered. Raises SourceError.
    """
    try:
        lines = (line.split("#")[0].strip() for line in path.read_text().splitlines())
        rows = np.array([[float(v) for v in line.split(",")] for line in lines if line]).reshape(-1, 7)
    except (OSError, ValueError) as e:
        reason = e.strerror if isinstance(e, OSError) else e
        raise SourceError(f"{path}: cannot be read as a list of boxes ({reason}): expected {_ROWS}") from None
    if not len(rows) or not np.isfinite(rows).all() or (rows[:, 3:6] <= 0.0).any():
        raise SourceError(f"{path}: expected {_ROWS}")
    boxes = np.column_stack([rows[:, :6], np.cos(rows[:, 6]), np.sin(rows[:, 6])])
    floor_m = float(boxes[0, 2] - boxes[0, 5])
    far_m = float(2.5 * np.linalg.norm(boxes[0, 3:6]))
    no_pool = TexturePool(np.zeros(0, np.uint8), np.zeros((0, 1), np.int64), ())
    no_faces, no_surfaces = np.zeros((6 * len(boxes), 8)), np.zeros((4, 8))
    return World(boxes, no_faces, 0, NO_GROUND, np.zeros(7), no_surfaces, no_pool, far_m, floor_m)

"""The job that builds the occupancy grid of the whole map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid import GridMap, build
from kiteline_basestation.jobs import JobKind

_CELLS_A_RAY = 60  # cells that a ray crosses on average


@dataclass(frozen=True, slots=True)
class GridInputs:
    """Arguments of `grid.build`."""

    config: GridConfig
    positions: NDArray[np.float64]
    points: NDArray[np.float64]
    observations: NDArray[np.int64]


def _run(inputs: GridInputs) -> GridMap:
    return build(inputs.config, inputs.positions, inputs.points, inputs.observations)


def _cost_ops(inputs: GridInputs, result: GridMap) -> int:
    return 300_000 + 10 * _CELLS_A_RAY * len(inputs.observations) + 200 * len(inputs.points)


GRID = JobKind("grid", _run, _cost_ops)

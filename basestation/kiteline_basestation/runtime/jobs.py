"""Long work, apart from the state machine: a Job holds all it needs, and `run_job` is a pure function of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.grid.grid import GridConfig, GridMap, build
from kiteline_basestation.merging.essential_graph import GraphInputs, GraphResult, optimise
from kiteline_core.optimisation.bundle import BundleConfig, BundleProblem, BundleResult, bundle

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class BundleInputs:
    """A bundle adjustment."""

    problem: BundleProblem
    config: BundleConfig


@dataclass(frozen=True, slots=True)
class GridInputs:
    """An occupancy grid from the whole map; see `grid.build`."""

    config: GridConfig
    positions: F64
    points: F64
    observations: I64


@dataclass(frozen=True, slots=True)
class Job:
    """Work to be done elsewhere. kind: "bundle", "full" (a bundle of a whole map), "graph", "grid"."""

    id: int
    kind: str
    inputs: BundleInputs | GraphInputs | GridInputs


@dataclass(frozen=True, slots=True)
class JobDone:
    """What a job gave. cost_ops: arithmetic operations, at one a nanosecond on the modelled core."""

    id: int
    result: BundleResult | GraphResult | GridMap
    cost_ops: int


def run_job(job: Job) -> JobDone:
    """Do a job. The same job gives the same result, byte for byte."""
    inputs = job.inputs
    if isinstance(inputs, BundleInputs):
        result = bundle(inputs.problem, inputs.config)
        return JobDone(job.id, result, result.cost_ops)
    if isinstance(inputs, GraphInputs):
        moved = optimise(inputs)
        return JobDone(job.id, moved, moved.cost_ops)
    grid = build(inputs.config, inputs.positions, inputs.points, inputs.observations)
    rays = 60 * len(inputs.observations)  # a ray crosses some 60 cells
    return JobDone(job.id, grid, 300_000 + 10 * rays + 200 * len(inputs.points))

"""When the occupancy grid is built anew, and which of its tiles are sent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.grid.grid import Grid, states
from kiteline_basestation.grid.grid_job import GRID, GridInputs
from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.ids import SubmapId, agent_of_submap


class GridUpdates:
    """One grid job at a time, of all placed submaps. placements: S_w_m (4,4) of each, kept up to date by its owner."""

    def __init__(
        self, config: BaseConfig, sparse_map: SparseMap, placements: Mapping[SubmapId, NDArray[np.float64]],
        publisher: Publisher, job_ids: Iterator[int],
    ) -> None:  # fmt: skip
        self._config = config
        self._map = sparse_map
        self._placements = placements
        self._publisher = publisher
        self._job_ids = job_ids
        self._new_keyframes = 0  # since the last grid
        self._pending: int | None = None
        self.grid = Grid(config.grid)

    @property
    def pending(self) -> int:
        """Number of pending jobs."""
        return int(self._pending is not None)

    def add_keyframe(self) -> None:
        """Count a new keyframe."""
        self._new_keyframes += 1

    def rebuild(self) -> None:
        """Make a grid due because the map moved as a whole."""
        self._new_keyframes = max(self._new_keyframes, len(self._map))

    def jobs(self) -> list[Job]:
        """The grid, if it is due."""
        publish = self._config.publish
        pause = max(publish.grid_every, len(self._map) // publish.grid_share)
        if self._pending is not None or self._new_keyframes < pause:
            return []
        self._new_keyframes = 0
        view = placed_map(self._map, self._placements)
        self._pending = next(self._job_ids)
        return [Job(self._pending, GRID.name, GridInputs(self._config.grid, view.positions, view.points, view.rays))]

    def finish(self, done: JobDone) -> bool:
        """Take a finished grid, and send its changed tiles to all agents that have a placed submap."""
        if done.id != self._pending:
            return False
        self._pending = None
        tiles = self.grid.adopt(done.result)
        for agent in sorted({agent_of_submap(s) for s in self._placements}):
            for tile in tiles:
                self._publisher.send(agent, replace(tile, cells=states(tile.cells)))
        return True

"""Column scans of single images, as an agent makes them, without a flight: at known poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid_view import dense
from kiteline_basestation.grid.kept_scan import keep
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_bench.harness.recording import Recording
from kiteline_core.frame import Frame
from kiteline_core.geometry.cameras import CameraRig, Rectifier
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityStripes
from kiteline_core.ground.segmentation import GroundSegmenter
from kiteline_lab.grids.files import FREE, OCCUPIED, GridFile

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PosedScan:
    """A scan and the true pose (4,4) of its camera."""

    scan: ColumnScan
    T_w_c: F64


class Scanner:
    """Makes scans of the stereo pairs of a rig, each with the ground that the ones before saw, as an agent does.

    damage: changes the disparity image first. ground_z: of the ground where the vehicle took off, None if it saw none.
    """

    def __init__(
        self, rig: CameraRig, damage: Callable[[F32], F32] | None = None, ground_z: float | None = None
    ) -> None:
        self._ground_z = ground_z
        self._rectifier = Rectifier(rig)
        self.camera = self._rectifier.camera
        self._segmenter = GroundSegmenter(self.camera, GroundConfig())
        self._stripes = DisparityStripes(self._segmenter.camera, GroundConfig())
        self._damage = damage

    def scan(self, frame: Frame, T_w_b: F64) -> PosedScan:
        """The scan of a frame whose true body pose (4,4) tells which way is up."""
        assert frame.right is not None
        T_w_c = T_w_b @ self.camera.T_b_c
        disparity = self._stripes.measure(self._rectifier.half(0, frame.left), self._rectifier.half(1, frame.right))
        if self._damage is not None:
            disparity = self._damage(disparity)
        z, up_c = float(T_w_c[2, 3]), np.ascontiguousarray(T_w_c[2, :3])
        expected_m = None if self._ground_z is None else z - self._ground_z
        scan = self._segmenter.segment(disparity, self._stripes.pair, up_c, None, expected_m)
        if np.isfinite(scan.camera_height_m):
            self._ground_z = z - scan.camera_height_m
        return PosedScan(scan, T_w_c)


def scans_of(recording: Recording, every: int, damage: Callable[[F32], F32] | None = None) -> list[PosedScan]:
    """Scans of every n-th frame of a recording that has a right image and a true pose."""
    scanner = Scanner(recording.rig, damage)
    return [
        scanner.scan(item.frame, item.T_w_b)
        for item in recording.items[::every]
        if item.frame.right is not None and item.T_w_b is not None
    ]


def grid_config(scans: Iterable[PosedScan]) -> GridConfig:
    """The base's options with a middle storey at the ground that the scans saw."""
    ground = np.array([s.T_w_c[2, 3] - s.scan.camera_height_m for s in scans])
    known = ground[np.isfinite(ground)]
    return replace(GridConfig(), ground_m=float(np.median(known)) if len(known) else 0.0)


def drawn(scans: Sequence[PosedScan], bf_px_m: float, config: GridConfig | None = None) -> ScanGrid:
    """The base's grid of scans at their true poses, numbered in their order."""
    config = config or grid_config(scans)
    grid = ScanGrid(config)
    for k, posed in enumerate(scans):
        kept = keep(config, posed.scan, bf_px_m)
        if kept is not None:
            grid.put(k, kept, posed.T_w_c)
    return grid


def as_file(grid: ScanGrid) -> GridFile:
    """The main storey of a grid, as it would be read from its file."""
    cells, corner, cell_m = dense(grid, grid.main_storey())
    states = np.where(cells > 0, OCCUPIED, np.where(cells == 0, FREE, -1)).astype(np.int8)
    return GridFile(cell_m, (float(corner[0]), float(corner[1]), 0.0), states)

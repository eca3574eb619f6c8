"""Column scans of single images, as an agent makes them, without a flight: at known poses."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid_view import dense
from kiteline_basestation.grid.kept_scan import keep
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_bench.harness.recording import Recording
from kiteline_core.arrays import F32, F64
from kiteline_core.frame import Frame
from kiteline_core.geometry.cameras import CameraRig, Rectifier
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityStripes
from kiteline_core.ground.ground_height import GroundHeight, Seen, without_ground
from kiteline_core.ground.segmentation import GroundSegmenter
from kiteline_core.ground.wide_view import WideView
from kiteline_lab.grids.files import FREE, OCCUPIED, GridFile


@dataclass(frozen=True, slots=True)
class PosedScan:
    """A scan and the true pose (4,4) of its camera."""

    scan: ColumnScan
    T_w_c: F64


class Scanner:
    """Makes scans of the stereo pairs of a rig, each with the ground that the ones before saw, as an agent does.

    damage: changes the disparity image first. ground_z: of the ground, where the vehicle knows it from the start.
    """

    def __init__(
        self, rig: CameraRig, damage: Callable[[F32], F32] | None = None, ground_z: float | None = None
    ) -> None:
        self._ground: GroundHeight[int] = GroundHeight()
        self._start_z = ground_z
        self._made: list[PosedScan] = []
        self._believed: set[int] = set()
        self._rectifier = Rectifier(rig)
        self.camera = self._rectifier.camera
        self._view = WideView(self._rectifier, GroundConfig())
        self._segmenter = GroundSegmenter(self._view.camera, GroundConfig())
        self._stripes = DisparityStripes(self._segmenter.camera, GroundConfig())
        self._damage = damage

    def scan(self, frame: Frame, T_w_b: F64) -> None:
        """Make the scan of a frame whose true body pose (4,4) tells which way is up."""
        assert frame.right is not None
        T_w_c = T_w_b @ self.camera.T_b_c
        halves = (np.asarray(cv2.pyrDown(image), np.uint8) for image in (frame.left, frame.right))
        disparity = self._view.mask(self._stripes.measure(*self._view.pair(*halves)))
        self._stripes.learn_brightness(disparity)
        if self._damage is not None:
            disparity = self._damage(disparity)
        if self._start_z is not None and not self._made:
            self._ground.start_at(np.array([*T_w_c[:2, 3], self._start_z]))
        up_c = np.ascontiguousarray(T_w_c[2, :3])
        segmenter, expected = self._segmenter, self._ground.expected(T_w_c, up_c)
        found = segmenter.segment(disparity, self._stripes.pair, up_c, None, expected)
        self._made.append(PosedScan(found.scan, T_w_c))
        verdict = self._ground.note(len(self._made) - 1, Seen(T_w_c, *found))
        self._believed = (self._believed | set(verdict.believed)) - set(verdict.withdrawn)

    def scans(self) -> list[PosedScan]:
        """All scans; of those that are not believed, the line of sight alone."""
        return [
            posed if k in self._believed else replace(posed, scan=without_ground(posed.scan))
            for k, posed in enumerate(self._made)
        ]


def scans_of(recording: Recording, every: int) -> list[PosedScan]:
    """Scans of every n-th frame of a recording that has a right image and a true pose."""
    scanner = Scanner(recording.rig)
    for item in recording.items[::every]:
        if item.frame.right is not None and item.T_w_b is not None:
            scanner.scan(item.frame, item.T_w_b)
    return scanner.scans()


def grid_config(scans: Iterable[PosedScan]) -> GridConfig:
    """The base's options with a middle storey at the ground that the scans saw."""
    ground = np.array([s.T_w_c[2, 3] - s.scan.camera_height_m for s in scans])
    known = ground[np.isfinite(ground)]
    return replace(GridConfig(), ground_m=float(np.median(known)) if len(known) else 0.0)


def drawn(scans: Sequence[PosedScan], bf_px_m: float) -> ScanGrid:
    """The base's grid of scans at their true poses, numbered in their order."""
    config = grid_config(scans)
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

"""Leaves out parts of the image that stand still while the camera turns, and names them for the user."""

from dataclasses import replace

import cv2
import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging.features import DetectorConfig
from kiteline_agent.imaging.fixed_parts import CELL_PX, FixedParts, FixedPartsConfig
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64, Bool
from kiteline_core.geometry.cameras import Rectifier

_AGAIN_S, _GROWN = 3.0, 1.3  # s from the first find, or the last event, to the next one; factor of growth since
_NAMED = 8  # parts that an event names, the largest ones
_INSIDE_PX = 0.5  # by which a part is smaller than its cells, so that rounding adds none
_MARGIN_PX = 16.0  # by which a part is larger for scans: matching of disparities reaches as far beyond its edge
_NOTHING = np.zeros((0, 4))


class FixedPartsStage:
    """Call `step` with each tracked frame. covered: what is left out now, as in `detector.covered`.

    named: the same in a few rectangles with a margin, as the last event named it.
    """

    def __init__(
        self, local_map: LocalMap, rectifier: Rectifier, config: FixedPartsConfig, detector: DetectorConfig
    ) -> None:  # fmt: skip
        self._map = local_map
        self._size = np.array([local_map.camera.width, local_map.camera.height], np.float64)
        self._by_user = detector.covered
        camera, left, right = local_map.camera, rectifier.left_grid, rectifier.right_grid
        self._parts = FixedParts(camera, config, detector.covered_parts, left)
        self._right = FixedParts(camera, config, _NOTHING, right) if camera.stereo else None
        self.covered = detector.covered
        self.named: tuple[float, ...] = ()
        self._since_ns: int | None = None  # of the first find or the last event
        self._told_cells = 0

    @property
    def cells(self) -> Bool:
        """Cells (rows, columns) of the left image that stand still."""
        return self._parts.cells

    def interrupt(self) -> None:
        """The frame has no pose from its images."""
        self._parts.interrupt()
        if self._right is not None:
            self._right.interrupt()

    def step(self, ctx: FrameContext, track: Track, T_o_c: F64) -> bool:
        """Look at a tracked frame of the camera at T_o_c (4,4). True if parts have changed.

        Landmarks that were seen first where a part is found are dropped: they are the vehicle's own.
        """
        if ctx.repeated:
            return False
        t_ns, depths_m, right, changed = ctx.t_ns, track.depth_m[track.inlier], ctx.images.right, False
        if self._right is not None and right is not None and self._right.is_due(t_ns, T_o_c):
            changed = self._right.look(t_ns, right.coarse()[1], T_o_c, depths_m)  # both turn alike
        before = self._parts.cells
        if self._parts.is_due(t_ns, T_o_c) and self._parts.look(t_ns, ctx.images.half(), T_o_c, depths_m):
            self._map.drop_within(self._parts.cells & ~before, CELL_PX)
            self.covered = (*self._by_user, *_rectangles(_runs(self._parts.cells), self._size, _INSIDE_PX))
            changed = True
        return changed

    def applied(self, config: AgentConfig) -> AgentConfig:
        """The configuration that leaves `covered` out."""
        return replace(config, detector=replace(config.detector, covered=self.covered))

    def for_scans(self) -> tuple[F64, F64]:
        """Left, top, right, bottom (n,4) of what scans leave out in the left and the right image, with a margin."""
        user = np.reshape(self._by_user, (-1, 4))
        left, right = (
            np.reshape(_rectangles(_runs(parts.cells), self._size, -_MARGIN_PX), (-1, 4)) if parts else _NOTHING
            for parts in (self._parts, self._right)
        )
        return np.concatenate([user, left]), right

    def take_events(self, t_ns: int) -> list[str]:
        """Name the parts once they are found, and when they have grown or are all gone."""
        cells = int(np.count_nonzero(self._parts.cells))
        if not cells:
            told, self._told_cells, self._since_ns, self.named = self._told_cells, 0, None, ()
            return ["images: no part stands still any more: all of them is used"] if told else []
        if self._since_ns is None:
            self._since_ns = t_ns
        if cells <= _GROWN * self._told_cells or t_ns - self._since_ns < _AGAIN_S * 1e9:
            return []
        self._since_ns, self._told_cells = t_ns, cells
        self.named = _rectangles(_boxes(self._parts.cells), self._size, -_MARGIN_PX)
        share, listed = cells / self._parts.cells.size, ", ".join(f"{value:.2f}" for value in self.named)
        said = f"images: {100 * share:.0f} % stand still while the camera turns, and are left out. If they show the "
        return [f"{said}vehicle or an overlay, set covered = [{listed}] in [agent.detector]"]


def _runs(cells: Bool) -> F64:
    """Left, top, right, bottom (n,4) of the rows' runs of cells."""
    edges = np.diff(np.pad(cells.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    (row, left), (_, right) = np.nonzero(edges == 1), np.nonzero(edges == -1)
    return np.column_stack([left, row, right, row + 1]).astype(np.float64)


def _boxes(cells: Bool) -> F64:
    """Left, top, right, bottom (n,4) of the largest connected groups of cells."""
    stats = cv2.connectedComponentsWithStats(cells.astype(np.uint8), connectivity=8)[2][1:]
    x, y, w, h, _ = stats[np.argsort(-stats[:, cv2.CC_STAT_AREA], kind="stable")[:_NAMED]].T
    return np.column_stack([x, y, x + w, y + h]).astype(np.float64)


def _rectangles(cells: F64, size: F64, inside_px: float = 0.0) -> tuple[float, ...]:
    """Rectangles (n,4) of cells as shares of an image of this size (2,) px."""
    px = cells * CELL_PX + [inside_px, inside_px, -inside_px, -inside_px]
    return tuple(np.clip(px / np.tile(size, 2), 0.0, 1.0).ravel().tolist())

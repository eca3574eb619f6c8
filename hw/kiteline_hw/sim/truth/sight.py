"""What of a world true camera poses could see: cells with a line of sight, by height band."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64, U8
from kiteline_core.geometry.cameras import CameraModel
from kiteline_hw.sim.sensors.lens import pixel_rays
from kiteline_hw.sim.truth.occupancy import FREE, OCCUPIED, TrueGrid, occupancy
from kiteline_hw.sim.truth.sight_kernels import mark_sight
from kiteline_hw.sim.world.raycast_kernels import NO_SHELL, visible_boxes
from kiteline_hw.sim.world.world import World

HEIGHTS_M = (0.1, 0.5, 1.2, 2.0)  # above the ground: limits of the height bands; what is lower is ground
CELL_M = 0.05
RANGE_M = 6.0  # m, horizontal; beyond, a disparity step of a small stereo rig is several cells
_RAYS_A_RAD = 115  # at RANGE_M two rays are about a cell apart, and many poses see each cell
_MOVED_M, _TURNED_RAD = 0.15, 0.1  # between two poses that are cast


@dataclass(frozen=True, slots=True)
class SeenWorld:
    """A world and what was seen of it. passed, ended: (rows, columns), see `mark_sight`; bit 0 is the ground."""

    world: World
    cell_m: float
    heights_m: tuple[float, ...]
    passed: U8
    ended: U8

    def grid(self, low_m: float | None = None, high_m: float | None = None, seen: bool = True) -> TrueGrid:
        """True occupancy between two limits of height bands; of all bands by default.

        `seen`: an occupied cell is known if a ray of sight ends in one of these bands. A free one is known if its
        ground was seen; of a single band also if a ray crosses the band. All other cells are UNKNOWN.
        """
        low, high = low_m or self.heights_m[0], high_m or self.heights_m[-1]
        grid = occupancy(self.world, low, high, self.cell_m)
        if not seen:
            return grid
        first, last = self.heights_m.index(low) + 1, self.heights_m.index(high) + 1
        bits = sum(1 << k for k in range(first, last))
        through = self.passed & (1 | (bits if last == first + 1 else 0))
        return grid.only(
            np.where(grid.image == FREE, through > 0, (grid.image == OCCUPIED) & ((self.ended & bits) > 0))
        )


def look(
    world: World, camera: CameraModel, T_w_c: F64, *, cell_m: float = CELL_M, range_m: float = RANGE_M,
    heights_m: tuple[float, ...] = HEIGHTS_M,
) -> SeenWorld:  # fmt: skip
    """Cast the camera's pixels into the world from its true poses (n,4,4)."""
    grid = occupancy(world, heights_m[0], heights_m[-1], cell_m)
    xy = grid.centres()
    ground = world.height(xy.reshape(-1, 2)).reshape(grid.image.shape).astype(np.float32)
    passed, ended = np.zeros(grid.image.shape, np.uint8), np.zeros(grid.image.shape, np.uint8)
    every = max(1, round(camera.fx / _RAYS_A_RAD))
    rays = pixel_rays(camera)[1:-1:every, 1:-1:every].reshape(-1, 3).astype(np.float64)
    axis = rays.mean(0) / np.linalg.norm(rays.mean(0))
    half_angle = float(np.arccos(np.clip((rays @ axis).min(), -1.0, 1.0))) + 0.01
    shell = NO_SHELL if world.shell is None else world.shell
    near, items = np.empty(len(world.boxes)), np.empty(len(world.boxes), np.int32)
    for pose in _apart(T_w_c):
        o, rot = np.ascontiguousarray(pose[:3, 3]), np.ascontiguousarray(pose[:3, :3])
        count = visible_boxes(world.boxes, shell, o, rot @ axis, half_angle, near, items)
        mark_sight(
            world.boxes, shell, world.field, world.field_frame, near, items, count, o, rays @ rot.T, range_m, ground,
            grid.corner, cell_m, np.array(heights_m), passed, ended,
        )  # fmt: skip
    return SeenWorld(world, cell_m, heights_m, passed, ended)


def _apart(T_w_c: F64) -> list[F64]:
    """Poses (4,4) of a path, each some distance or angle from the one before."""
    kept: list[F64] = []
    for pose in T_w_c:
        if kept:
            cos = 0.5 * (np.trace(kept[-1][:3, :3].T @ pose[:3, :3]) - 1.0)
            moved = np.linalg.norm(pose[:3, 3] - kept[-1][:3, 3])
            if moved < _MOVED_M and np.arccos(np.clip(cos, -1.0, 1.0)) < _TURNED_RAD:
                continue
        kept.append(pose)
    return kept

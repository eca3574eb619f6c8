"""The true occupancy grid of a world, whether its cells were seen or not."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from kiteline_core.arrays import F64, U8, Bool
from kiteline_hw.durable_files import write_atomically
from kiteline_hw.sim.world.world import World

OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # grey values of map_server images
MARGIN_M = 0.3  # m of unknown cells around the walls


@dataclass(frozen=True, slots=True)
class TrueGrid:
    """A grid of grey values. image: (rows, columns), row 0 the lowest y. corner: (2,) its lower left in w."""

    image: U8
    corner: F64
    cell_m: float

    def centres(self) -> F64:
        """Centres (rows, columns, 2) of the cells."""
        r, c = np.indices(self.image.shape)
        return np.stack([self.corner[0] + (c + 0.5) * self.cell_m, self.corner[1] + (r + 0.5) * self.cell_m], 2)

    def only(self, known: Bool) -> "TrueGrid":
        """The grid with all other cells UNKNOWN. known: (rows, columns)."""
        return replace(self, image=np.where(known, self.image, np.uint8(UNKNOWN)))


def occupancy(world: World, low_m: float, high_m: float, cell_m: float = 0.05) -> TrueGrid:
    """True occupancy between two heights above the floor.

    A cell is OCCUPIED where a solid or a wall reaches into it, FREE elsewhere inside the shell (outdoors: within the
    field), UNKNOWN behind the walls.
    """
    if world.shell is not None:
        extent = world.boxes[world.shell]
        lower, upper = extent[:2] - extent[3:5] - MARGIN_M, extent[:2] + extent[3:5] + MARGIN_M
    else:
        frame = world.field_frame
        lower = frame[:2]
        upper = lower + frame[2] * (np.array(world.field.shape[:0:-1]) - 1)
    lower = np.floor(lower / cell_m) * cell_m
    columns, rows = (int(v) for v in np.ceil((upper - lower) / cell_m))
    image = np.full((rows, columns), FREE, np.uint8)
    half = 0.5 * cell_m

    def cells_around(box: F64) -> tuple[slice, slice, F64, F64]:
        """Rows and columns around a box, and the cells' distances from its centre along its axes."""
        radius = float(np.hypot(box[3], box[4])) + cell_m
        x0, y0 = np.maximum(((box[:2] - radius - lower) / cell_m).astype(int), 0)
        x1, y1 = np.maximum(((box[:2] + radius - lower) / cell_m).astype(int) + 1, 0)
        ys, xs = slice(y0, min(y1, rows)), slice(x0, min(x1, columns))
        y, x = np.mgrid[ys, xs]
        dx, dy = lower[0] + (x + 0.5) * cell_m - box[0], lower[1] + (y + 0.5) * cell_m - box[1]
        return ys, xs, np.abs(box[6] * dx + box[7] * dy), np.abs(box[6] * dy - box[7] * dx)

    if world.shell is not None:
        ys, xs, x, y = cells_around(world.boxes[world.shell])
        image[:] = UNKNOWN
        sx, sy = extent[3:5]
        image[ys, xs][(x < sx + cell_m) & (y < sy + cell_m)] = OCCUPIED
        image[ys, xs][(x < sx - half + 1e-9) & (y < sy - half + 1e-9)] = FREE
    for box in world.solids():
        floor = float(world.height(box[None, :2])[0])
        if box[2] + box[5] <= floor + low_m or box[2] - box[5] >= floor + high_m:
            continue
        ys, xs, x, y = cells_around(box)
        spread = half * (abs(box[6]) + abs(box[7]))  # half-width of a square cell along the box's axes
        inside = (x < box[3] + spread) & (y < box[4] + spread)
        view = image[ys, xs]
        view[inside & (view != UNKNOWN)] = OCCUPIED
    return TrueGrid(image, lower, cell_m)


def write_grid(grid: TrueGrid, file: Path) -> Path:
    """Write `file` (.yaml) and the PGM beside it, in the format of ROS's map_server; returns `file`."""
    picture = file.with_name(file.name.removesuffix(".yaml") + ".pgm")
    ok, data = cv2.imencode(".pgm", grid.image[::-1])
    assert ok
    write_atomically(picture, data.tobytes())
    text = (
        f"image: {picture.name}\nmode: trinary\nresolution: {grid.cell_m:g}\n"
        f"origin: [{grid.corner[0]:.6f}, {grid.corner[1]:.6f}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    write_atomically(file, text.encode())
    return file

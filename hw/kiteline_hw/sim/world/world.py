"""A world of textured solids: its arrays, its builder, and its true occupancy grid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path as FilePath

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_hw.sim.world.textures import TEXEL_M, TexturePool

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # grey values of map_server images
NO_GROUND = np.zeros((0, 1, 1), np.float32)


@dataclass(frozen=True, slots=True)
class World:
    """Solids, ground and textures.

    boxes (n, 8): centre x y z, half-extents x y z in m, cos yaw, sin yaw. faces (6 n, 8): see raycast_kernels.
    shell: the box whose inside is the room, None outdoors.
    field (2, rows, columns) float32: ground height and distance to the path in m, empty indoors; its frame (7,): x0 y0
    cell in m, largest slope, then unused, road half-width, far side of the pavement. ground (4, 8): the surfaces of
    road, pavement, lawn and sky, laid out as faces. floor_m: z of the floor, outdoors at the path's start.
    """

    boxes: F64
    faces: F64
    shell: int | None
    field: F32
    field_frame: F64
    ground: F64
    pool: TexturePool
    far_m: float
    floor_m: float

    def solids(self) -> F64:
        """The boxes without the shell, (m, 8)."""
        return np.delete(self.boxes, self.shell, axis=0) if self.shell is not None else self.boxes

    def height(self, xy: F64) -> F64:
        """z of the floor or the ground under points (n, 2)."""
        if self.field.shape[0] == 0:
            return np.full(len(xy), self.floor_m)
        return bilinear(self.field[0], self.field_frame, xy)


def bilinear(field: F32, frame: F64, xy: F64) -> F64:
    """Values of a field (rows, columns) at points (n, 2); frame starts with x0, y0, cell."""
    u = np.clip((xy[:, 0] - frame[0]) / frame[2], 0.0, field.shape[1] - 1.001)
    v = np.clip((xy[:, 1] - frame[1]) / frame[2], 0.0, field.shape[0] - 1.001)
    i, j = u.astype(int), v.astype(int)
    fu, fv = u - i, v - j
    low = field[j, i] * (1 - fu) + field[j, i + 1] * fu
    return np.asarray(low * (1 - fv) + (field[j + 1, i] * (1 - fu) + field[j + 1, i + 1] * fu) * fv)


def box_distances(box: F64, points: F64) -> F64:
    """Distances in m (n,) of points (n, 3) to a solid box (8,); 0 inside."""
    d = points - box[:3]
    x = np.abs(box[6] * d[:, 0] + box[7] * d[:, 1]) - box[3]
    y = np.abs(box[6] * d[:, 1] - box[7] * d[:, 0]) - box[4]
    z = np.abs(d[:, 2]) - box[5]
    return np.asarray(np.sqrt(np.maximum(x, 0) ** 2 + np.maximum(y, 0) ** 2 + np.maximum(z, 0) ** 2))


class Builder:
    """Collects solids that keep a distance from the paths, and assigns a piece of texture to every face.

    path_points (n, 3): points along all paths, at most 0.1 m apart indoors.
    """

    def __init__(self, rng: np.random.Generator, pool: TexturePool, path_points: F64, clearance_m: float) -> None:
        self.rng = rng
        self.pool = pool
        self.points = path_points
        self.clearance_m = clearance_m
        self._boxes: list[F64] = []
        self._faces: list[F64] = []

    def face(self, name: str, contrast: float, brightness: float, upright: bool, base_m: float = 0.0) -> F64:
        """A face (8,) with a random piece of a texture; `upright`: not rotated, rows start base_m below the centre."""
        rng = self.rng
        stretch = 1.0 / (TEXEL_M * rng.uniform(0.85, 1.2))
        side = 1 << int(self.pool.table[self.pool.index(name), 0])
        signs = np.where(rng.random(2) < 0.5, -1.0, 1.0)
        offset = rng.uniform(0, side, 2)
        swap = float(rng.random() < 0.5)
        if upright:
            signs[1], offset[1], swap = 1.0, base_m * stretch, 0.0
        light = brightness * rng.uniform(0.85, 1.15)
        depth = contrast * rng.uniform(0.8, 1.2)
        scale = stretch * signs
        return np.array([scale[0], scale[1], offset[0], offset[1], light, depth, float(self.pool.index(name)), swap])

    def clear(self, box: F64) -> bool:
        """True if a box keeps the distance from the paths."""
        reach = self.clearance_m + float(np.linalg.norm(box[3:6]))
        near = self.points[(np.abs(self.points - box[:3]) < reach).all(1)]
        return len(near) == 0 or float(box_distances(box, near).min()) >= self.clearance_m

    def add(self, centre: F64, half: F64, yaw: float, faces: F64, force: bool = False) -> bool:
        """Add a box with faces (6, 8) unless it is too near to a path (and not `force`); True if it was added."""
        box = np.array([*centre, *half, np.cos(yaw), np.sin(yaw)])
        if not force and not self.clear(box):
            return False
        self._boxes.append(box)
        self._faces.append(faces)
        return True

    def arrays(self) -> tuple[F64, F64]:
        """All boxes (n, 8) and faces (6 n, 8), in the order in which they were added."""
        return np.array(self._boxes).reshape(-1, 8), np.array(self._faces).reshape(-1, 8)


def occupancy(
    world: World, low_m: float, high_m: float, resolution_m: float = 0.05, margin_m: float = 0.3
) -> tuple[U8, F64]:
    """True occupancy between two heights above the floor: image (rows, columns), first row the highest y; origin (2,).

    A cell is OCCUPIED where a solid or a wall reaches into it, FREE elsewhere inside the shell (outdoors: within the
    field), UNKNOWN behind the walls. The origin is the lower left corner of the lower left cell in w.
    """
    if world.shell is not None:
        extent = world.boxes[world.shell]
        lower, upper = extent[:2] - extent[3:5] - margin_m, extent[:2] + extent[3:5] + margin_m
    else:
        frame = world.field_frame
        lower = frame[:2]
        upper = lower + frame[2] * (np.array(world.field.shape[:0:-1]) - 1)
    lower = np.floor(lower / resolution_m) * resolution_m
    columns, rows = (int(v) for v in np.ceil((upper - lower) / resolution_m))
    image = np.full((rows, columns), FREE, np.uint8)
    half = 0.5 * resolution_m

    def cells_around(box: F64) -> tuple[slice, slice, F64, F64]:
        """Rows and columns around a box, and the cells' distances from its centre along its axes."""
        radius = float(np.hypot(box[3], box[4])) + resolution_m
        x0, y0 = np.maximum(((box[:2] - radius - lower) / resolution_m).astype(int), 0)
        x1, y1 = np.maximum(((box[:2] + radius - lower) / resolution_m).astype(int) + 1, 0)
        ys, xs = slice(y0, min(y1, rows)), slice(x0, min(x1, columns))
        y, x = np.mgrid[ys, xs]
        dx, dy = lower[0] + (x + 0.5) * resolution_m - box[0], lower[1] + (y + 0.5) * resolution_m - box[1]
        return ys, xs, np.abs(box[6] * dx + box[7] * dy), np.abs(box[6] * dy - box[7] * dx)

    if world.shell is not None:
        ys, xs, x, y = cells_around(world.boxes[world.shell])
        image[:] = UNKNOWN
        sx, sy = extent[3:5]
        image[ys, xs][(x < sx + resolution_m) & (y < sy + resolution_m)] = OCCUPIED
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
    return image[::-1].copy(), lower


def write_occupancy(image: U8, origin: F64, resolution_m: float, file: FilePath) -> None:
    """Write `file` (.yaml) and the PGM beside it, in the format of ROS's map_server."""
    picture = file.with_suffix(".pgm")
    ok, data = cv2.imencode(".pgm", image)
    assert ok
    picture.write_bytes(data.tobytes())
    file.write_text(
        f"image: {picture.name}\nresolution: {resolution_m}\norigin: [{origin[0]:.6f}, {origin[1]:.6f}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )

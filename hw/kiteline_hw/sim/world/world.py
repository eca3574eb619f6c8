"""A world of textured solids: its arrays and its builder."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F32, F64
from kiteline_hw.sim.world.textures import TEXEL_M, TexturePool

NO_GROUND = np.zeros((0, 1, 1), np.float32)


@dataclass(frozen=True, slots=True)
class World:
    """Solids, ground and textures.

    boxes (n, 8): centre x y z, half-extents x y z in m, cos yaw, sin yaw. faces (6 n, 8): see raycast_kernels.
    shell: the box whose inside is the room, None outdoors.
    field (2, rows, columns) float32: ground height and distance to the path in m, empty indoors; its frame (7,): x0 y0
    cell in m, largest slope, then unused, road half-width, far side of the pavement. ground (4, 8): the surfaces of
    road, pavement, lawn and sky, laid out as faces; a floor that is not flat is all road. floor_m: z of the floor,
    outdoors at the path's start, the highest of a floor that is not flat. objects: kind, first box and last box + 1 of
    each object that is made of several boxes.
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
    objects: tuple[tuple[str, int, int], ...] = ()

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

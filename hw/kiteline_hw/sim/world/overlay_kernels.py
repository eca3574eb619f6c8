"""Draws moving solids over an image of the still ones."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from kiteline_hw.sim.world.raycast_kernels import NO_SHELL, SKY, TILE, cast_ray, shade_hit

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]


@njit(cache=True, nogil=True)
def overlay(
    boxes: F64, faces: F64, field: F32, frame: F64, ground: F64, atlas: U8, table: NDArray[np.int64], detail_m: float,
    o: F64, rot: F64, rays: F32, pixel: float, far: float, near: F64, items: I32, lists: I32, lengths: I32, first: int,
    radiance: F32, distance: F32, hits: I32,
) -> None:  # fmt: skip
    """Replace radiance, distance and hits (h, w) where a box is nearer than what is drawn there; see `render`.

    Every pixel of a tile with boxes gets four sub-pixel rays; those that miss keep the radiance. first: number of the
    first box in `hits`. field: empty, so that rays meet boxes only.
    """
    height, width = radiance.shape
    columns = (width + TILE - 1) // TILE
    for tile in range(lengths.shape[0]):
        if lengths[tile] == 0:
            continue
        x0, y0 = (tile % columns) * TILE, (tile // columns) * TILE
        for y in range(y0, min(y0 + TILE, height)):
            for x in range(x0, min(x0 + TILE, width)):
                total, count, nearest, seen = 0.0, 0, np.inf, 0
                c, cx, cy = rays[y + 1, x + 1], rays[y + 1, x + 2], rays[y + 2, x + 1]
                for k in range(4):
                    su = (-0.125, 0.375, -0.375, 0.125)[k]
                    sv = (-0.375, -0.125, 0.125, 0.375)[k]
                    r0 = c[0] + su * (cx[0] - c[0]) + sv * (cy[0] - c[0])
                    r1 = c[1] + su * (cx[1] - c[1]) + sv * (cy[1] - c[1])
                    r2 = c[2] + su * (cx[2] - c[2]) + sv * (cy[2] - c[2])
                    dx = rot[0, 0] * r0 + rot[0, 1] * r1 + rot[0, 2] * r2
                    dy = rot[1, 0] * r0 + rot[1, 1] * r1 + rot[1, 2] * r2
                    dz = rot[2, 0] * r0 + rot[2, 1] * r1 + rot[2, 2] * r2
                    t, hit = cast_ray(
                        boxes, NO_SHELL, field, frame, near, items, lists, tile, lengths[tile], o, dx, dy, dz, far
                    )
                    if hit == SKY or t >= distance[y, x]:
                        continue
                    count += 1
                    total += shade_hit(
                        boxes, faces, NO_SHELL, field, frame, ground, atlas, table, detail_m, o, dx, dy, dz, t, hit,
                        pixel,
                    )  # fmt: skip
                    if t < nearest:
                        nearest, seen = t, hit
                if count > 0:
                    radiance[y, x] = (total + (4 - count) * radiance[y, x]) / 4.0
                if count > 1:
                    distance[y, x] = nearest
                    hits[y, x] = 6 * first + seen

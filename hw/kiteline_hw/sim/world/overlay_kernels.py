"""Draws moving solids over an image of the still ones."""

import numpy as np
from numba import njit

from kiteline_core.arrays import F32, F64, I32, I64, U8
from kiteline_hw.sim.world.raycast_kernels import NO_SHELL, SKY, TILE, cast_ray, sample_ray, shade_hit


@njit(cache=True, nogil=True)
def overlay(
    boxes: F64, faces: F64, field: F32, frame: F64, ground: F64, atlas: U8, table: I64, detail_m: float,
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
                for k in range(4):
                    dx, dy, dz = sample_ray(rays, rot, y, x, k)
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

"""Kernel that marks the cells of a grid which rays of sight cross. Arrays in, caller's arrays out."""

import numpy as np
from numba import njit

from kiteline_core.arrays import F32, F64, I32, U8
from kiteline_hw.sim.world.raycast_kernels import box_hit, ground_hit

_INTO_M = 1e-4  # m behind a surface that is hit: its cell is that of the solid


@njit(cache=True, nogil=True)
def mark_sight(
    boxes: F64, shell: int, field: F32, frame: F64, near: F64, items: I32, count: int, o: F64, rays: F64,
    range_m: float, ground: F32, corner: F64, cell_m: float, edges: F64, passed: U8, ended: U8,
) -> None:  # fmt: skip
    """Follow rays of sight to the first solid, and mark in which height bands they cross and end in each cell.

    near, items, count: the boxes around, as `visible_boxes` orders them. o: (3,) camera. rays: (n,3) unit vectors in w.
    range_m: largest horizontal distance. ground: (rows, columns) z of the ground. corner: (2,) of the grid.
    edges: (b,) heights above the ground; band k lies below edges[k] and not below edges[k - 1], band 0 is the ground.
    passed, ended: (rows, columns), out: bit k is set where a ray crosses, or ends in, band k of a cell.
    """
    rows, columns = ground.shape
    bands = edges.shape[0]
    for i in range(rays.shape[0]):
        dx, dy, dz = rays[i, 0], rays[i, 1], rays[i, 2]
        flat = np.sqrt(dx * dx + dy * dy)
        if flat < 1e-9:
            continue
        limit = range_m / flat
        best = limit
        if shell >= 0:
            t, _ = box_hit(boxes, shell, o, dx, dy, dz, True)
            best = min(best, t)
        for m in range(count):
            if near[m] >= best:
                break
            t, _ = box_hit(boxes, items[m], o, dx, dy, dz, False)
            best = min(best, t)
        if field.shape[0] > 0:
            best = min(best, ground_hit(field, frame, o, dx, dy, dz, best))
        hits = best < limit
        end = best + _INTO_M if hits else limit
        # Cells in cell units (J. Amanatides and A. Woo, "A fast voxel traversal algorithm", 1987).
        x, y = (o[0] - corner[0]) / cell_m, (o[1] - corner[1]) / cell_m
        ux, uy = dx / cell_m, dy / cell_m
        c, r = int(np.floor(x)), int(np.floor(y))
        sc, sr = (1 if ux > 0 else -1), (1 if uy > 0 else -1)
        tc = ((c + (sc > 0)) - x) / ux if ux != 0.0 else np.inf
        tr = ((r + (sr > 0)) - y) / uy if uy != 0.0 else np.inf
        wide = abs(1.0 / ux) if ux != 0.0 else np.inf
        tall = abs(1.0 / uy) if uy != 0.0 else np.inf
        enter = 0.0
        while enter < end:
            if c < 0 or r < 0 or c >= columns or r >= rows:
                break
            leave = min(tc, tr)
            last = leave >= end
            a, b = o[2] + enter * dz - ground[r, c], o[2] + min(leave, end) * dz - ground[r, c]
            low, high = min(a, b), max(a, b)
            for k in range(bands):
                if low < edges[k] and (k == 0 or high >= edges[k - 1]):
                    passed[r, c] |= np.uint8(1 << k)
            if last and hits:
                k = 0
                while k < bands and b >= edges[k]:
                    k += 1
                if k < bands:
                    ended[r, c] |= np.uint8(1 << k)
            enter = leave
            if tc < tr:
                tc += wide
                c += sc
            else:
                tr += tall
                r += sr


@njit(cache=True, nogil=True)
def level_distances(boxes: F64, shell: int, xy: F64, heights: F64, angles: F64, out: F64) -> None:
    """Distance to the nearest solid along level rays. xy: (2,). heights: (h,) z. angles: (n,). out: (n, h)."""
    o = np.empty(3)
    o[0], o[1] = xy[0], xy[1]
    for j in range(heights.shape[0]):
        o[2] = heights[j]
        for i in range(angles.shape[0]):
            dx, dy = np.cos(angles[i]), np.sin(angles[i])
            best = np.inf
            for k in range(boxes.shape[0]):
                t, _ = box_hit(boxes, k, o, dx, dy, 0.0, k == shell)
                best = min(best, t)
            out[i, j] = best

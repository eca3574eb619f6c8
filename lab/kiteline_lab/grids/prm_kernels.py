"""Kernels of road maps on a grid: places at a distance, straight roads. Arrays in, caller's arrays out."""

import numpy as np

from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.jit import njit


@njit
def spaced_places(places: F64, apart: float, chosen: F64) -> int:
    """Choose from places (n,2), in their order, those that lie at least `apart` from all chosen before.

    chosen: (m,2), filled until it is full. Returns how many were chosen.
    """
    count = 0
    for i in range(places.shape[0]):
        if count == chosen.shape[0]:
            break
        near = False
        for k in range(count):
            dx, dy = places[i, 0] - chosen[k, 0], places[i, 1] - chosen[k, 1]
            if dx * dx + dy * dy < apart * apart:
                near = True
                break
        if not near:
            chosen[count, 0], chosen[count, 1] = places[i, 0], places[i, 1]
            count += 1
    return count


@njit
def roads_free(free: Bool, nodes: F64, pairs: I64, out: Bool) -> None:
    """Check whether each straight road crosses free cells only.

    free: (rows, columns). nodes: (n,2) column, row in cells, fractions included. pairs: (p,2) rows of nodes. out: (p,).
    Every cell that the line enters counts (J. Amanatides and A. Woo, "A fast voxel traversal algorithm", 1987); cells
    outside of the grid are not free.
    """
    rows, columns = free.shape
    for i in range(pairs.shape[0]):
        x, y = nodes[pairs[i, 0], 0], nodes[pairs[i, 0], 1]
        dx, dy = nodes[pairs[i, 1], 0] - x, nodes[pairs[i, 1], 1] - y
        c, r = int(np.floor(x)), int(np.floor(y))
        last_c, last_r = int(np.floor(x + dx)), int(np.floor(y + dy))
        sc = 1 if dx > 0 else -1
        sr = 1 if dy > 0 else -1
        # Along the line, in parts of its length: where the next column and the next row begin, and how far apart.
        tc = ((c + (sc > 0)) - x) / dx if dx != 0.0 else np.inf
        tr = ((r + (sr > 0)) - y) / dy if dy != 0.0 else np.inf
        wide = abs(1.0 / dx) if dx != 0.0 else np.inf
        tall = abs(1.0 / dy) if dy != 0.0 else np.inf
        good = True
        for _ in range(abs(last_c - c) + abs(last_r - r) + 1):
            if c < 0 or r < 0 or c >= columns or r >= rows or not free[r, c]:
                good = False
                break
            if tc < tr:
                tc += wide
                c += sc
            else:
                tr += tall
                r += sr
        out[i] = good

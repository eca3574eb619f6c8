"""Kernels that cast rays into a pool of grid tiles and propagate the ground height.

The pool holds the tiles in use; `slots` (rows, columns) int32 maps a tile of the box to its index, -1 none. Cells are
numbered from the lower left corner of the box; a tile has 64x64 cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core.jit import njit

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

TILE = 64  # cells along a side of a tile: the shape of a Tile record
SHIFT, MASK = 6, TILE - 1  # quotient and remainder by TILE, the main cost of the inner loop as a division
COUNT_MAX = 65535  # counts are uint16 and saturate


@njit
def mark_points(
    column: I64, row: I64, z: F64, weight: I64, slots: I32, used: int, hits: U16, low: F32, high: F32
) -> int:
    """Add obstacle points to their cells. column, row, z, weight: (n,). hits, low, high: (capacity, 64, 64).

    `low` and `high` (initially +inf, -inf) receive the height range of obstacles in each cell. The pool must have room
    for one new tile per point. Returns the number of tiles in use.
    """
    for i in range(column.shape[0]):
        c, r = column[i], row[i]
        tile = slots[r // TILE, c // TILE]
        if tile < 0:
            tile = used
            slots[r // TILE, c // TILE] = tile
            used += 1
        y, x = r % TILE, c % TILE
        hits[tile, y, x] = min(COUNT_MAX, hits[tile, y, x] + weight[i])
        low[tile, y, x] = min(low[tile, y, x], z[i])
        high[tile, y, x] = max(high[tile, y, x], z[i])
    return used


@njit
def cast_rays(
    start: I64, end: I64, z: F64, ceiling: F64, short: I64, first: int, slots: I32, used: int, margin_m: float,
    free: U16, through: U16, low: F32, high: F32,
) -> tuple[int, int]:  # fmt: skip
    """Count rays in cells (Bresenham, integers only). start, end: (n,2) column, row. z: (n,2) heights at both ends.

    A step below ceiling[i] counts in `free`. A step between a cell's `low` and `high` (widened by margin_m) counts in
    `through`. The last short[i] cells are left out. Begins with ray `first` and stops before a ray for which the pool
    may be too small. Returns (next ray, tiles in use).
    """
    capacity = free.shape[0]
    for i in range(first, start.shape[0]):
        c, r = start[i, 0], start[i, 1]
        dc, dr = end[i, 0] - c, end[i, 1] - r
        ac, ar = abs(dc), abs(dr)
        steps = max(ac, ar)
        if used + (ac + ar) // TILE + 3 > capacity:
            return i, used
        sc = 1 if dc > 0 else -1
        sr = 1 if dr > 0 else -1
        error = ac - ar
        slope = (z[i, 1] - z[i, 0]) / steps if steps > 0 else 0.0
        old_r, old_c, tile = -1, -1, -1
        for k in range(steps + 1 - short[i]):
            height = z[i, 0] + slope * k
            tr, tc = r >> SHIFT, c >> SHIFT
            if tr != old_r or tc != old_c:
                tile = slots[tr, tc]
                old_r, old_c = tr, tc
            y, x = r & MASK, c & MASK
            if height < ceiling[i]:
                if tile < 0:
                    tile = used
                    slots[tr, tc] = tile
                    used += 1
                if free[tile, y, x] < COUNT_MAX:
                    free[tile, y, x] += 1
            if tile >= 0:
                inside = low[tile, y, x] - margin_m < height < high[tile, y, x] + margin_m
                if inside and through[tile, y, x] < COUNT_MAX:
                    through[tile, y, x] += 1
            twice = 2 * error
            if twice > -ar:
                error -= ar
                c += sc
            if twice < ac:
                error += ac
                r += sr
    return start.shape[0], used


@njit
def spread_ground(
    histogram: F32, seed: int, seed_bin: int, reach: int, share: float, least: float, ground: I32, queue: I32
) -> None:
    """Find the height bin of the ground in every patch by breadth-first search from a known patch.

    histogram: (rows, columns, bins) point counts by height. The ground of a patch is the lowest peak within `reach`
    bins of its neighbour's ground that has at least `share` of the highest count there and `least` points; without
    one, its neighbour's ground. seed: row * columns + column. ground: (rows, columns), out.
    queue: (rows * columns,) scratch.
    """
    rows, columns, bins = histogram.shape
    for r in range(rows):
        for c in range(columns):
            ground[r, c] = -1
    ground[seed // columns, seed % columns] = seed_bin
    queue[0] = seed
    head, tail = 0, 1
    while head < tail:
        r, c = queue[head] // columns, queue[head] % columns
        head += 1
        around = ground[r, c]
        for side in range(4):
            nr = r + (side == 0) - (side == 1)
            nc = c + (side == 2) - (side == 3)
            if nr < 0 or nc < 0 or nr >= rows or nc >= columns or ground[nr, nc] >= 0:
                continue
            first, last = max(0, around - reach), min(bins - 1, around + reach)
            top = np.float32(0.0)
            for b in range(first, last + 1):
                top = max(top, histogram[nr, nc, b])
            found = around
            need = max(share * top, least)
            for b in range(first, last + 1):
                count = histogram[nr, nc, b]
                if count >= need and (b == last or count >= histogram[nr, nc, b + 1]):
                    found = b
                    break
            ground[nr, nc] = found
            queue[tail] = nr * columns + nc
            tail += 1

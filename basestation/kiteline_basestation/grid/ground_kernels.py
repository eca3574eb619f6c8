"""Kernel that propagates the height of the ground."""

import numpy as np

from kiteline_core.arrays import F32, I32
from kiteline_core.jit import njit


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

"""Kernels of sparse landmarks: the height of the ground, which are not alone, and where their rays free cells."""

import numpy as np

from kiteline_core.arrays import F32, F64, I32, I64, U8
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


@njit
def mark_accompanied(points: F64, radius: float, out: U8) -> None:
    """Set out (n,) to 1 for points (n,3) with another one within a radius, else to 0."""
    n, square = points.shape[0], radius * radius
    for i in range(n):
        out[i] = 0
    for i in range(n):
        if out[i]:
            continue
        for j in range(n):
            dx, dy, dz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
            if j != i and dx * dx + dy * dy + dz * dz <= square:
                out[i] = out[j] = 1
                break


@njit
def mark_rays(
    azimuth: F64, start: F64, end: F64, stop: F64, first_rad: float, step_rad: float, width: float, bin_m: float,
    free: U8,
) -> None:  # fmt: skip
    """Mark what rays free: in their own columns, and within a width beside them up to an obstacle.

    azimuth, start, end: (m,) of rays that are low from start to end. stop: (n,) nearest obstacle of each column, inf
    without. first_rad: lower edge of column 0. free: (n, bins) by range, out; what is set stays set.
    """
    columns, bins = free.shape
    for i in range(azimuth.shape[0]):
        own = int(np.floor((azimuth[i] - first_rad) / step_rad))
        for way in (1, -1):
            column = own if way == 1 else own - 1
            while 0 <= column < columns:
                apart = 0.0 if column == own else abs(first_rad + (column + 0.5) * step_rad - azimuth[i])
                reach = end[i] if apart * end[i] <= width else width / apart
                if reach <= start[i]:
                    break
                first = max(int(np.rint(start[i] / bin_m)), 0)
                for k in range(first, min(int(np.rint(min(reach, stop[column]) / bin_m)), bins)):
                    free[column, k] = 1
                if stop[column] < reach and column != own:
                    break
                column += way


@njit
def clear_around(
    azimuth: F64, distance: F64, first_rad: float, step_rad: float, width: float, bin_m: float, free: U8
) -> None:
    """Take back what lies within a width of landmarks (m,) that stand. free: as in `mark_rays`."""
    columns, bins = free.shape
    for i in range(azimuth.shape[0]):
        half = np.arcsin(min(width / max(distance[i], 1e-6), 1.0))
        lower = int(np.floor((azimuth[i] - half - first_rad) / step_rad))
        upper = int(np.floor((azimuth[i] + half - first_rad) / step_rad))
        near = max(int(np.rint((distance[i] - width) / bin_m)), 0)
        for column in range(max(lower, 0), min(upper, columns - 1) + 1):
            for k in range(near, min(int(np.rint((distance[i] + width) / bin_m)), bins)):
                free[column, k] = 0


@njit
def longest_runs(free: U8, runs: I64) -> None:
    """First bin, and the one after the last, of the longest run in each column, the nearest of equal ones.

    free: (n, bins). runs: (n,2), out.
    """
    for column in range(free.shape[0]):
        runs[column, 0] = runs[column, 1] = 0
        begin = 0
        for k in range(free.shape[1] + 1):
            if k < free.shape[1] and free[column, k]:
                continue
            if k - begin > runs[column, 1] - runs[column, 0]:
                runs[column, 0], runs[column, 1] = begin, k
            begin = k + 1

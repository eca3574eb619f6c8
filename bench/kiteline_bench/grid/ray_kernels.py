"""Kernel that casts rays over a dense grid. Arrays in, caller's arrays out."""

from kiteline_core.arrays import F64, I64
from kiteline_core.jit import njit


@njit
def cast_rays(
    start: I64,
    end: I64,
    z: F64,
    ceiling: F64,
    short: I64,
    margin_m: float,
    low: F64,
    high: F64,
    free: I64,
    through: I64,
) -> None:
    """Count rays in cells (Bresenham). start, end: (n,2) column, row inside of the grid. z: (n,2) heights at both ends.

    low, high: (rows, columns) heights of obstacles in each cell. free, through: (rows, columns), out: steps of rays
    below ceiling (n,), and steps between low and high, widened by margin_m. The last short (n,) cells are left out.
    """
    for i in range(start.shape[0]):
        c, r = start[i, 0], start[i, 1]
        ac, ar = abs(end[i, 0] - c), abs(end[i, 1] - r)
        steps = max(ac, ar)
        sc = 1 if end[i, 0] > c else -1
        sr = 1 if end[i, 1] > r else -1
        error = ac - ar
        slope = (z[i, 1] - z[i, 0]) / steps if steps > 0 else 0.0
        for k in range(steps + 1 - short[i]):
            height = z[i, 0] + slope * k
            if height < ceiling[i]:
                free[r, c] += 1
            if low[r, c] - margin_m < height < high[r, c] + margin_m:
                through[r, c] += 1
            twice = 2 * error
            if twice > -ar:
                error -= ar
                c += sc
            if twice < ac:
                error += ac
                r += sr

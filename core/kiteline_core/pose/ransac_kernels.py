"""Kernels shared by all RANSACs: seeded draws, their number, and the cost of a pose."""

import numpy as np

from kiteline_core.arrays import F64, I64, U64
from kiteline_core.jit import helper, njit


@helper
def draw(state: U64, n: int) -> int:
    """The next number in [0, n) of a xorshift64* generator (S. Vigna, 2016). state: (1,) uint64, not 0, in and out."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return int(((x * np.uint64(0x2545F4914F6CDD1D)) >> np.uint64(33)) % np.uint64(n))


@helper
def draws_needed(share: float, confidence: float, most: int) -> int:
    """Number of draws of three until one has no outlier with the given confidence. share: of inliers."""
    bad = 1.0 - share * share * share
    if bad <= 0.0:
        return 1
    if bad >= 1.0:
        return most
    return min(most, int(np.log(1.0 - confidence) / np.log(bad)) + 1)


@njit
def three(state: U64, n: int, pick: I64) -> None:
    """Draw three different numbers in [0, n) into pick (3,)."""
    pick[0] = draw(state, n)
    pick[1] = draw(state, n - 1)
    if pick[1] >= pick[0]:
        pick[1] += 1
    pick[2] = draw(state, n - 2)
    if pick[2] >= min(pick[0], pick[1]):
        pick[2] += 1
    if pick[2] >= max(pick[0], pick[1]):
        pick[2] += 1


@helper
def reprojection_cost(T: F64, point: F64, uv: F64, limit_px: F64, camera: F64, give_up: float) -> float:
    """Sum over points of squared error over squared limit, at most 1 each (MSAC). Stops above `give_up`."""
    total = 0.0
    for i in range(point.shape[0]):
        p0, p1, p2 = point[i, 0], point[i, 1], point[i, 2]
        z = T[2, 0] * p0 + T[2, 1] * p1 + T[2, 2] * p2 + T[2, 3]
        if z > 0.05:
            du = camera[0] * (T[0, 0] * p0 + T[0, 1] * p1 + T[0, 2] * p2 + T[0, 3]) / z + camera[2] - uv[i, 0]
            dv = camera[1] * (T[1, 0] * p0 + T[1, 1] * p1 + T[1, 2] * p2 + T[1, 3]) / z + camera[3] - uv[i, 1]
            total += min(1.0, (du * du + dv * dv) / (limit_px[i] * limit_px[i]))
        else:
            total += 1.0
        if total >= give_up:
            return total
    return total

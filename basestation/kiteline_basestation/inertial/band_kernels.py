"""Kernel for normal equations of a chain: a symmetric band, with a border of a few unknowns that all rows share."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.jit import njit


@njit
def factor(band: F64, border: F64, corner: F64, rhs: F64, corner_rhs: F64) -> bool:
    """Eliminate the band in place: Cholesky over rows. False if it is not positive definite.

    band (n,w): row j holds columns j..j+w-1. border (n,b): its columns of the corner (b,b), which is left reduced, as
    is corner_rhs (b,).
    """
    n, w = band.shape
    b = border.shape[1]
    for j in range(n):
        if not band[j, 0] > 1e-12:
            return False
        d = 1.0 / np.sqrt(band[j, 0])
        for k in range(w):
            band[j, k] *= d
        for k in range(b):
            border[j, k] *= d
        rhs[j] *= d
        for i in range(1, min(w, n - j)):
            u = band[j, i]
            if u == 0.0:
                continue
            for k in range(i, w):
                band[j + i, k - i] -= u * band[j, k]
            for k in range(b):
                border[j + i, k] -= u * border[j, k]
            rhs[j + i] -= u * rhs[j]
        for i in range(b):
            u = border[j, i]
            for k in range(b):
                corner[i, k] -= u * border[j, k]
            corner_rhs[i] -= u * rhs[j]
    return True


@njit
def substitute(band: F64, border: F64, rhs: F64, x_corner: F64) -> None:
    """Find the band's unknowns, into rhs, after `factor`; x_corner (b,) solves the corner."""
    n, w = band.shape
    for j in range(n - 1, -1, -1):
        v = rhs[j]
        for k in range(border.shape[1]):
            v -= border[j, k] * x_corner[k]
        for k in range(1, min(w, n - j)):
            v -= band[j, k] * rhs[j + k]
        rhs[j] = v / band[j, 0]

"""Kernels on the lower triangle of the filter's covariance; no value depends on what its upper triangle holds.

Sums run in a fixed order, so that the same input gives the same bits.
"""

import numpy as np

from kiteline_core.arrays import F64, I64
from kiteline_core.jit import njit


@njit
def add_products(P: F64, rows: F64, sign: float) -> None:
    """Add sign * rows^T rows to the lower triangle of P's first n rows. rows: (m,n), m and n multiples of four.

    Four rows of P take four products at a time, since to load and store numbers takes as long as to multiply them.
    """
    m, n = rows.shape
    for i in range(0, n, 4):
        p0, p1, p2, p3 = P[i], P[i + 1], P[i + 2], P[i + 3]
        for k in range(0, m, 4):
            a = rows[k : k + 4, i : i + 4]
            a00, a01, a02, a03 = sign * a[0, 0], sign * a[0, 1], sign * a[0, 2], sign * a[0, 3]
            a10, a11, a12, a13 = sign * a[1, 0], sign * a[1, 1], sign * a[1, 2], sign * a[1, 3]
            a20, a21, a22, a23 = sign * a[2, 0], sign * a[2, 1], sign * a[2, 2], sign * a[2, 3]
            a30, a31, a32, a33 = sign * a[3, 0], sign * a[3, 1], sign * a[3, 2], sign * a[3, 3]
            r0, r1, r2, r3 = rows[k], rows[k + 1], rows[k + 2], rows[k + 3]
            for j in range(i + 4):
                x0, x1, x2, x3 = r0[j], r1[j], r2[j], r3[j]
                p0[j] += (a00 * x0 + a10 * x1) + (a20 * x2 + a30 * x3)
                p1[j] += (a01 * x0 + a11 * x1) + (a21 * x2 + a31 * x3)
                p2[j] += (a02 * x0 + a12 * x1) + (a22 * x2 + a32 * x3)
                p3[j] += (a03 * x0 + a13 * x1) + (a23 * x2 + a33 * x3)


@njit
def symmetric_rows(P: F64, n: int, index: I64, out: F64) -> None:
    """Copy whole rows of the symmetric P. index: (m,). out: (m, n)."""
    for a in range(len(index)):
        for j in range(index[a]):
            out[a, j] = P[index[a], j]
    for j in range(n):  # row by row, since neighbours in a column lie far apart
        for a in range(len(index)):
            if index[a] <= j:
                out[a, j] = P[j, index[a]]


@njit
def set_row(P: F64, n: int, i: int, row: F64) -> None:
    """Set row and column i of the symmetric P. row: (n,)."""
    for j in range(i + 1):
        P[i, j] = row[j]
    for j in range(i + 1, n):
        P[j, i] = row[j]


@njit
def innovation_covariance(P: F64, index: I64, M: F64, noise: float, S: F64) -> None:
    """Covariance of pixels that are M (xi_l - xi_p) from their prediction.

    index: (m,) first rows of the landmarks in P; the camera's position is its rows 0 to 2. M: (m,2,3). noise: variance
    of a pixel coordinate. S: (2m,2m), filled as a whole.
    """
    block = np.empty((3, 3))
    half = np.empty((2, 3))
    for a in range(len(index)):
        la = index[a]
        for b in range(a + 1):
            lb = index[b]
            for r in range(3):
                for c in range(3):
                    i, j = la + r, lb + c
                    ll = P[i, j] if i >= j else P[j, i]
                    pp = P[r, c] if r >= c else P[c, r]
                    block[r, c] = ll - P[i, c] - P[j, r] + pp
            for r in range(2):
                for c in range(3):
                    half[r, c] = M[a, r, 0] * block[0, c] + M[a, r, 1] * block[1, c] + M[a, r, 2] * block[2, c]
            for r in range(2):
                for c in range(2):
                    value = half[r, 0] * M[b, c, 0] + half[r, 1] * M[b, c, 1] + half[r, 2] * M[b, c, 2]
                    if a == b and r == c:
                        value += noise
                    S[2 * a + r, 2 * b + c] = value
                    S[2 * b + c, 2 * a + r] = value


@njit
def compatible_set(S: F64, residual: F64, order: I64, gate: float, L: F64, white: F64, taken: I64) -> int:
    """Take matches in an order, each if it fits given those taken before; returns how many are taken.

    S: (2m,2m) innovation covariance. residual: (2m,). order: (k,) matches. gate: squared deviations, two degrees of
    freedom, of a match given the ones before. L (2m,2m), white (2m,): columns of the Cholesky factor of the taken, one
    after the other, and their whitened residuals. taken: (m,) the matches, in the order in which they were taken.
    """
    count = 0
    left = np.empty((2, S.shape[0]))  # of the two rows that a match adds to the factor, beyond the columns done
    for k in range(len(order)):
        a = order[k]
        n = 2 * count
        for b in range(count):
            for c in range(2):
                left[0, 2 * b + c] = S[2 * a, 2 * taken[b] + c]
                left[1, 2 * b + c] = S[2 * a + 1, 2 * taken[b] + c]
        s00, s10, s11 = S[2 * a, 2 * a], S[2 * a + 1, 2 * a], S[2 * a + 1, 2 * a + 1]
        r0, r1 = residual[2 * a], residual[2 * a + 1]
        for c in range(n):  # column by column: unlike sums along rows these loops need no order of their own
            column = L[c]
            u, v = left[0, c] / column[c], left[1, c] / column[c]
            left[0, c], left[1, c] = u, v
            for j in range(c + 1, n):
                left[0, j] -= u * column[j]
                left[1, j] -= v * column[j]
            s00 -= u * u
            s10 -= u * v
            s11 -= v * v
            r0 -= u * white[c]
            r1 -= v * white[c]
        d0 = np.sqrt(max(s00, 1e-12))
        e = s10 / d0
        d1 = np.sqrt(max(s11 - e * e, 1e-12))
        w0 = r0 / d0
        w1 = (r1 - e * w0) / d1
        if w0 * w0 + w1 * w1 <= gate:
            for c in range(n):
                L[c, n], L[c, n + 1] = left[0, c], left[1, c]
            L[n, n], L[n, n + 1], L[n + 1, n + 1] = d0, e, d1
            white[n], white[n + 1] = w0, w1
            taken[count] = a
            count += 1
    return count

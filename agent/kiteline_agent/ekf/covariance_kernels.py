"""Kernels on the lower triangle of the filter's covariance: its upper triangle is neither read nor written.

Sums run in a fixed order, so that the same input gives the same bits.
"""

import numpy as np

from kiteline_core.arrays import F64, I64
from kiteline_core.jit import njit


@njit
def add_rows(P: F64, n: int, rows: F64, sign: float) -> None:
    """Add sign * rows^T rows to the first n rows of P. rows: (m, n or more)."""
    m = rows.shape[0]
    for i in range(n):
        p = P[i]
        k = 0
        while k + 8 <= m:
            a0, a1, a2, a3 = sign * rows[k, i], sign * rows[k + 1, i], sign * rows[k + 2, i], sign * rows[k + 3, i]
            a4, a5 = sign * rows[k + 4, i], sign * rows[k + 5, i]
            a6, a7 = sign * rows[k + 6, i], sign * rows[k + 7, i]
            r0, r1, r2, r3 = rows[k], rows[k + 1], rows[k + 2], rows[k + 3]
            r4, r5, r6, r7 = rows[k + 4], rows[k + 5], rows[k + 6], rows[k + 7]
            for j in range(i + 1):
                p[j] += ((a0 * r0[j] + a1 * r1[j]) + (a2 * r2[j] + a3 * r3[j])) + (
                    (a4 * r4[j] + a5 * r5[j]) + (a6 * r6[j] + a7 * r7[j])
                )
            k += 8
        while k < m:
            a0, r0 = sign * rows[k, i], rows[k]
            for j in range(i + 1):
                p[j] += a0 * r0[j]
            k += 1


@njit
def symmetric_rows(P: F64, n: int, index: I64, out: F64) -> None:
    """Copy whole rows of the symmetric P. index: (m,). out: (m, n)."""
    for a in range(len(index)):
        i = index[a]
        for j in range(i + 1):
            out[a, j] = P[i, j]
        for j in range(i + 1, n):
            out[a, j] = P[j, i]


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
    freedom, of a match given the ones before. L (2m,2m), white (2m,): the Cholesky factor of the taken and their
    whitened residuals. taken: (m,) the matches, in the order in which they were taken.
    """
    count = 0
    for k in range(len(order)):
        a = order[k]
        for r in range(2):
            row = 2 * count + r
            for c in range(row + 1):
                column = 2 * a + r if c == row else (2 * taken[c // 2] + c % 2 if c // 2 < count else 2 * a + c % 2)
                s = S[2 * a + r, column]
                for j in range(c):
                    s -= L[row, j] * L[c, j]
                if c < row:
                    L[row, c] = s / L[c, c]
                else:
                    L[row, c] = np.sqrt(max(s, 1e-12))
            s = residual[2 * a + r]
            for j in range(row):
                s -= L[row, j] * white[j]
            white[row] = s / L[row, row]
        if white[2 * count] ** 2 + white[2 * count + 1] ** 2 <= gate:
            taken[count] = a
            count += 1
    return count


@njit
def innovation_rows(P: F64, n: int, index: I64, M: F64, out: F64) -> None:
    """Rows M (P_l - P_p) of the covariance between pixels and state. index: (m,). M: (m,2,3). out: (2m,n)."""
    for a in range(len(index)):
        la = index[a]
        for j in range(n):
            for r in range(2):
                out[2 * a + r, j] = 0.0
        for c in range(3):
            u, v = M[a, 0, c], M[a, 1, c]
            i = la + c
            for j in range(i + 1):
                out[2 * a, j] += u * P[i, j]
                out[2 * a + 1, j] += v * P[i, j]
            for j in range(i + 1, n):
                out[2 * a, j] += u * P[j, i]
                out[2 * a + 1, j] += v * P[j, i]
            for j in range(c + 1):
                out[2 * a, j] -= u * P[c, j]
                out[2 * a + 1, j] -= v * P[c, j]
            for j in range(c + 1, n):
                out[2 * a, j] -= u * P[j, c]
                out[2 * a + 1, j] -= v * P[j, c]


@njit
def whiten_rows(L: F64, m: int, rows: F64) -> None:
    """Replace rows (m,n) by L^-1 rows; L: lower triangular, its first m rows."""
    n = rows.shape[1]
    for i in range(m):
        for k in range(i):
            f = L[i, k]
            for j in range(n):
                rows[i, j] -= f * rows[k, j]
        f = 1.0 / L[i, i]
        for j in range(n):
            rows[i, j] *= f


@njit
def weighted_sum(rows: F64, m: int, weight: F64, out: F64) -> None:
    """The sum (n,) of weight[k] * rows[k] over the first m rows."""
    for j in range(rows.shape[1]):
        out[j] = 0.0
    for k in range(m):
        f = weight[k]
        for j in range(rows.shape[1]):
            out[j] += f * rows[k, j]

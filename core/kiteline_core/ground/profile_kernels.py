"""Kernels that find the ground in the v-disparity: a first path by dynamic programming, then a B-spline."""

import numpy as np

from kiteline_core.ground.level_kernels import BIN_PX
from kiteline_core.jit import njit

SECTIONS = 5
COEFFICIENTS = SECTIONS + 3  # of a uniform cubic B-spline
_STEP_COST = 0.05  # of a row between two bins, in metres of ground
_LONGEST_M = 0.5  # m of ground in a bin that count
_UNEXPECTED = 0.3  # factor on what pixels count where the ground was not expected


@njit
def ground_path(counts, first, hint, hint_rows, bf, step_m, max_slope, sigma_px, half_counts, path):  # type: ignore[no-untyped-def]
    """Height of the ground (bins,) as rows of counts (bins, heights): the path with the most pixels and few steps.

    Pixels below the path count against it: nothing is seen through the ground. first: first row that may be ground.
    hint: row at which the ground is expected, -1 without; a path more than hint_rows from it counts little. The path
    goes from near to far; between bins it climbs by max_slope at most. half_counts: pixels of a cell that count half as
    much as many do.
    """
    bins, heights = counts.shape
    score = np.zeros(heights)
    back = np.zeros((bins, heights), np.int16)
    new = np.zeros(heights)
    sums = np.zeros(heights + 1)
    for j in range(bins - 1, 0, -1):
        d = (j + 0.5) * BIN_PX
        ahead = bf / (d * d) * BIN_PX  # m from bin to bin
        reach = min(int(max_slope * ahead / step_m) + 1, 30)
        for k in range(heights):
            sums[k + 1] = sums[k] + counts[j, k]
        for k in range(heights):
            back[j, k] = k
            new[k] = -1e9
            if k < first:
                continue
            best = -1e9
            for i in range(max(k - reach, first), min(k + reach + 1, heights)):
                s = score[i] - _STEP_COST * abs(i - k)
                if s > best:
                    best = s
                    back[j, k] = i
            spread = int((k + 0.5) * sigma_px / d)  # rows over which noise spreads the pixels of one height
            n = sums[min(k + spread + 1, heights)] - sums[max(k - spread, 0)]
            under = sums[heights] - sums[min(k + 3 * spread + 3, heights)]
            gain = n / (n + half_counts) - 0.5 * max(under - 2.0 * n, 0.0) / (under + half_counts)
            if hint >= 0 and abs(k - hint) > hint_rows and gain > 0.0:
                gain *= _UNEXPECTED
            new[k] = best + gain * min(ahead, _LONGEST_M)
        score, new = new, score
    best = first
    for k in range(first, heights):
        if score[k] > score[best]:
            best = k
    for j in range(1, bins):
        path[j] = best
        best = back[j, best]
    path[0] = path[1]


@njit
def count_near(counts, height_m, step_m, sigma_px, found):  # type: ignore[no-untyped-def]
    """Pixels (bins,) of counts (bins, heights) near a height (bins,) in m, as noise of sigma_px spreads them."""
    bins, heights = counts.shape
    for j in range(bins):
        row = height_m[j] / step_m - 0.5
        spread = 1.5 + 2.0 * row * sigma_px / ((j + 0.5) * BIN_PX)
        found[j] = 0
        for k in range(heights):
            if abs(k - row) <= spread:
                found[j] += counts[j, k]


@njit
def count_path(counts, path, sigma_px, found, total):  # type: ignore[no-untyped-def]
    """Pixels (bins,) of counts (bins, heights) near a path (bins,), and all of each bin."""
    bins, heights = counts.shape
    for j in range(bins):
        spread = 2.0 + 3.0 * (path[j] + 0.5) * sigma_px / ((j + 0.5) * BIN_PX)
        found[j], total[j] = 0, 0
        for k in range(heights):
            total[j] += counts[j, k]
            if abs(k - path[j]) <= spread:
                found[j] += counts[j, k]


@njit
def cells_near(counts, disparities, slopes, path, first, last, sigma_px, out):  # type: ignore[no-untyped-def]
    """Cells (bins, heights) with pixels near a path, of bins first..last. Returns how many there are.

    disparities, slopes: sums over pixels. out: (3, m) number of pixels, and the means of both.
    """
    n = 0
    for j in range(first, last + 1):
        spread = 2.0 + 3.0 * (path[j] + 0.5) * sigma_px / ((j + 0.5) * BIN_PX)
        for k in range(counts.shape[1]):
            if counts[j, k] > 0 and abs(k - path[j]) <= spread:
                pixels = float(counts[j, k])
                out[0, n], out[1, n], out[2, n] = pixels, disparities[j, k] / pixels, slopes[j, k] / pixels
                n += 1
    return n


@njit
def _basis(s):  # type: ignore[no-untyped-def]
    """The four cubic basis functions at s of a section, 0..1."""
    r = 1.0 - s
    ss, sss = s * s, s * s * s
    return r * r * r / 6.0, 0.5 * sss - ss + 2.0 / 3.0, 0.5 * (s + ss - sss) + 1.0 / 6.0, sss / 6.0


@njit
def _section(d, low, high):  # type: ignore[no-untyped-def]
    """Section of a disparity within low..high, and the place in it."""
    t = min(max((d - low) / (high - low), 0.0), 1.0) * SECTIONS
    i = min(int(t), SECTIONS - 1)
    return i, t - i


@njit
def _within(coefficients, low, high, d):  # type: ignore[no-untyped-def]
    """The spline at a disparity within low..high."""
    i, s = _section(d, low, high)
    b0, b1, b2, b3 = _basis(s)
    return b0 * coefficients[i] + b1 * coefficients[i + 1] + b2 * coefficients[i + 2] + b3 * coefficients[i + 3]


@njit
def spline_at(coefficients, low, high, d):  # type: ignore[no-untyped-def]
    """Slope -z/x of the ground at a levelled disparity.

    Nearer than low..high it goes on level, farther as it rises over the last part that was seen.
    """
    if d > high:
        return _within(coefficients, low, high, high) * d / high
    if d < low:
        step = 0.25 * (high - low)
        end = _within(coefficients, low, high, low)
        return end - (low - d) * (_within(coefficients, low, high, low + step) - end) / step
    return _within(coefficients, low, high, d)


@njit
def sample_spline(coefficients, low, high, d, out):  # type: ignore[no-untyped-def]
    """`spline_at` of levelled disparities d (n,)."""
    for i in range(len(d)):
        out[i] = spline_at(coefficients, low, high, d[i])


@njit
def _solve(A, b, x):  # type: ignore[no-untyped-def]
    """Solve A x = b for a symmetric positive definite A by elimination; A and b are overwritten."""
    n = len(b)
    for i in range(n):
        for j in range(i + 1, n):
            f = A[j, i] / A[i, i]
            for k in range(i, n):
                A[j, k] -= f * A[i, k]
            b[j] -= f * b[i]
    for i in range(n - 1, -1, -1):
        v = b[i]
        for k in range(i + 1, n):
            v -= A[i, k] * x[k]
        x[i] = v / A[i, i]


@njit
def fit_spline(disparity, slope, weight, low, high, sigma, stiffness, rounds, coefficients):  # type: ignore[no-untyped-def]
    """Fit a uniform cubic B-spline slope(disparity) by iterated least squares with Tukey's weights.

    disparity, slope, weight: (m,) of cells. sigma: (m,) standard deviations of slope. stiffness: weight of second
    differences of the coefficients, in units of the data's: level ground has none.
    """
    m = len(disparity)
    A = np.zeros((COEFFICIENTS, COEFFICIENTS))
    b = np.zeros(COEFFICIENTS)
    basis = np.zeros(4)
    for k in range(rounds):
        for p in range(COEFFICIENTS):
            b[p] = 0.0
            for q in range(COEFFICIENTS):
                A[p, q] = 0.0
        total = 0.0
        for i in range(m):
            at, s = _section(disparity[i], low, high)
            basis[0], basis[1], basis[2], basis[3] = _basis(s)
            w = weight[i] / (sigma[i] * sigma[i])
            if k > 0:
                r = slope[i]
                for p in range(4):
                    r -= basis[p] * coefficients[at + p]
                r /= 4.0 * sigma[i] * (2.0 if k == 1 else 1.0)
                if abs(r) >= 1.0:
                    continue
                w *= (1.0 - r * r) * (1.0 - r * r)
            total += w
            for p in range(4):
                b[at + p] += w * basis[p] * slope[i]
                for q in range(4):
                    A[at + p, at + q] += w * basis[p] * basis[q]
        if total <= 0.0:
            return False
        soft = stiffness * total
        for p in range(COEFFICIENTS - 2):
            for q in range(3):
                for r in range(3):
                    A[p + q, p + r] += soft * (1.0 if q != 1 else -2.0) * (1.0 if r != 1 else -2.0)
        for p in range(COEFFICIENTS):
            A[p, p] += 1e-9 * total
        _solve(A, b, coefficients)
    return True

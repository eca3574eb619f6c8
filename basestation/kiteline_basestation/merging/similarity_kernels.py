"""Kernels of point-set alignment, with or without scale, in a RANSAC seeded by the caller."""

import numpy as np

from kiteline_core.arrays import F64, U64, Bool
from kiteline_core.jit import njit
from kiteline_core.pose.ransac_kernels import draws_needed, reprojection_cost, three


@njit
def align_points(a: F64, b: F64, chosen: Bool, with_scale: bool, S_a_b: F64) -> bool:
    """Least-squares similarity a = S_a_b b over the chosen rows (B. Horn, 1987; scale symmetric in a and b).

    a, b: (n,3). S_a_b: (4,4) out, its upper left part scale times rotation. False if degenerate.
    """
    n = 0
    mean_a, mean_b = np.zeros(3), np.zeros(3)
    for i in range(a.shape[0]):
        if chosen[i]:
            n += 1
            for k in range(3):
                mean_a[k] += a[i, k]
                mean_b[k] += b[i, k]
    if n < 3:
        return False
    mean_a /= n
    mean_b /= n
    m = np.zeros((3, 3))
    spread_a, spread_b = 0.0, 0.0
    for i in range(a.shape[0]):
        if chosen[i]:
            for k in range(3):
                spread_a += (a[i, k] - mean_a[k]) ** 2
                spread_b += (b[i, k] - mean_b[k]) ** 2
                for j in range(3):
                    m[k, j] += (b[i, k] - mean_b[k]) * (a[i, j] - mean_a[j])
    h = np.empty((4, 4))
    h[0, 0] = m[0, 0] + m[1, 1] + m[2, 2]
    h[1, 1] = m[0, 0] - m[1, 1] - m[2, 2]
    h[2, 2] = -m[0, 0] + m[1, 1] - m[2, 2]
    h[3, 3] = -m[0, 0] - m[1, 1] + m[2, 2]
    h[0, 1], h[0, 2], h[0, 3] = m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]
    h[1, 2], h[1, 3], h[2, 3] = m[0, 1] + m[1, 0], m[2, 0] + m[0, 2], m[1, 2] + m[2, 1]
    for i in range(4):
        for j in range(i):
            h[i, j] = h[j, i]
    q = np.empty(4)
    if not _largest_eigenvector(h, q):
        return False
    w, x, y, z = q[0], q[1], q[2], q[3]
    scale = np.sqrt(spread_a / spread_b) if with_scale else 1.0
    S_a_b[0, 0], S_a_b[0, 1], S_a_b[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    S_a_b[1, 0], S_a_b[1, 1], S_a_b[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    S_a_b[2, 0], S_a_b[2, 1], S_a_b[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    for i in range(3):
        S_a_b[i, 3] = mean_a[i]
        S_a_b[3, i] = 0.0
        for j in range(3):
            S_a_b[i, j] *= scale
            S_a_b[i, 3] -= S_a_b[i, j] * mean_b[j]
    S_a_b[3, 3] = 1.0
    return True


@njit
def _largest_eigenvector(h: F64, q: F64) -> bool:
    """Unit eigenvector of the largest eigenvalue of a symmetric (4,4), by Jacobi rotations. False if two are equal."""
    v = np.eye(4)
    scale = 0.0
    for i in range(4):
        for j in range(4):
            scale += h[i, j] * h[i, j]
    for _ in range(12):
        off = 0.0
        for i in range(4):
            for j in range(i):
                off += h[i, j] * h[i, j]
        if off <= 1e-30 * scale:
            break
        for i in range(3):
            for j in range(i + 1, 4):
                if abs(h[i, j]) < 1e-300:
                    continue
                theta = 0.5 * (h[j, j] - h[i, i]) / h[i, j]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(4):
                    x, y = h[k, i], h[k, j]
                    h[k, i], h[k, j] = c * x - s * y, s * x + c * y
                for k in range(4):
                    x, y = h[i, k], h[j, k]
                    h[i, k], h[j, k] = c * x - s * y, s * x + c * y
                    x, y = v[k, i], v[k, j]
                    v[k, i], v[k, j] = c * x - s * y, s * x + c * y
    best = 0
    for i in range(1, 4):
        if h[i, i] > h[best, best]:
            best = i
    for i in range(4):
        if i != best and h[best, best] - h[i, i] <= 1e-9 * np.sqrt(scale):
            return False
    for k in range(4):
        q[k] = v[k, best]
    return True


@njit
def _invert(S: F64, out: F64) -> None:
    """Inverse of a similarity (4,4)."""
    scale2 = S[0, 0] * S[0, 0] + S[1, 0] * S[1, 0] + S[2, 0] * S[2, 0]
    for i in range(3):
        out[i, 3] = 0.0
        out[3, i] = 0.0
        for j in range(3):
            out[i, j] = S[j, i] / scale2
            out[i, 3] -= S[j, i] * S[j, 3] / scale2
    out[3, 3] = 1.0


@njit
def _store(S: F64, marked: Bool, S_a_b: F64, inlier: Bool) -> None:
    """Copy a similarity and its inliers to the outputs."""
    for i in range(4):
        for j in range(4):
            S_a_b[i, j] = S[i, j]
    for i in range(marked.shape[0]):
        inlier[i] = marked[i]


@njit
def align_ransac(
    a: F64, uv_a: F64, limit_a_px: F64, camera_a: F64, b: F64, uv_b: F64, limit_b_px: F64, camera_b: F64,
    with_scale: bool, most_draws: int, confidence: float, state: U64, S_a_b: F64, inlier: Bool,
) -> int:  # fmt: skip
    """The similarity between the points of two views with the most inliers in both images.

    a, b: (n,3) m in either camera, n >= 3. uv_*: (n,2) px of each. limit_*_px: (n,). camera_*: fx,
    fy, cx, cy. state: (1,) uint64 seed, in and out. S_a_b: (4,4) out. inlier: (n,) out: the pair reprojects within the
    limits both ways. Returns the number of inliers.
    """
    n = a.shape[0]
    pick = np.empty(3, np.int64)
    three_a, three_b, all3 = np.empty((3, 3)), np.empty((3, 3)), np.ones(3, np.bool_)
    S, back = np.empty((4, 4)), np.empty((4, 4))
    marked = np.empty(n, np.bool_)
    count, needed, k = 0, most_draws, 0
    while k < needed:
        k += 1
        three(state, n, pick)
        for i in range(3):
            for j in range(3):
                three_a[i, j], three_b[i, j] = a[pick[i], j], b[pick[i], j]
        if not align_points(three_a, three_b, all3, with_scale, S):
            continue
        _invert(S, back)
        support = _mark_pairs(S, back, a, uv_a, limit_a_px, camera_a, b, uv_b, limit_b_px, camera_b, marked)
        if support <= count:
            continue
        # Refit each new best similarity to its inliers while their number grows.
        while support > count:
            count = support
            _store(S, marked, S_a_b, inlier)
            if not align_points(a, b, inlier, with_scale, S):
                break
            _invert(S, back)
            support = _mark_pairs(S, back, a, uv_a, limit_a_px, camera_a, b, uv_b, limit_b_px, camera_b, marked)
        if support == count:
            _store(S, marked, S_a_b, inlier)
        needed = draws_needed(count / n, confidence, most_draws)
    if count == 0:
        for i in range(n):
            inlier[i] = False
    return count


@njit
def _mark_pairs(
    S: F64, back: F64, a: F64, uv_a: F64, limit_a: F64, camera_a: F64, b: F64, uv_b: F64, limit_b: F64, camera_b: F64,
    inlier: Bool,
) -> int:  # fmt: skip
    count = 0
    for i in range(a.shape[0]):
        one = slice(i, i + 1)
        inlier[i] = (
            reprojection_cost(S, b[one], uv_a[one], limit_a[one], camera_a, 2.0) < 1.0
            and reprojection_cost(back, a[one], uv_b[one], limit_b[one], camera_b, 2.0) < 1.0
        )
        count += inlier[i]
    return count

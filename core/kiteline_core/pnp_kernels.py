"""Kernels of absolute pose: P3P and three-point alignment, each in its own RANSAC with draws seeded by the caller."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core.jit import njit

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U64 = NDArray[np.uint64]


@njit
def draw(state: U64, n: int) -> int:
    """The next number in [0, n) of a xorshift64* generator (S. Vigna, 2016). state: (1,) uint64, not 0, in and out."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return int(((x * np.uint64(0x2545F4914F6CDD1D)) >> np.uint64(33)) % np.uint64(n))


@njit
def _real_cubic_root(b: float, c: float, d: float) -> float:
    """One real root of x^3 + b x^2 + c x + d, the steepest one, by Newton's method from a safe side."""
    if b * b >= 3.0 * c:
        v = np.sqrt(b * b - 3.0 * c)
        low = (-b - v) / 3.0
        value = ((low + b) * low + c) * low + d
        if value > 0.0:
            r = low - np.sqrt(max(-value / (3.0 * low + b), 0.0)) if 3.0 * low + b < 0.0 else low - 1.0
        else:
            high = (-b + v) / 3.0
            value = ((high + b) * high + c) * high + d
            r = high + np.sqrt(max(-value / (3.0 * high + b), 0.0)) if 3.0 * high + b > 0.0 else high + 1.0
    else:
        r = -b / 3.0
        if abs((3.0 * r + 2.0 * b) * r + c) < 1e-4:
            r += 1.0
    for _ in range(50):
        f = ((r + b) * r + c) * r + d
        slope = (3.0 * r + 2.0 * b) * r + c
        if slope == 0.0 or abs(f) < 1e-15:
            break
        step = f / slope
        r -= step
        if abs(step) < 1e-14 * (1.0 + abs(r)):
            break
    return float(r)


@njit
def _polish(length: F64, a12: float, a13: float, a23: float, b12: float, b13: float, b23: float) -> None:
    """Gauss-Newton on the three distances along the rays."""
    for _ in range(5):
        l1, l2, l3 = length[0], length[1], length[2]
        r1 = l1 * l1 + l2 * l2 + b12 * l1 * l2 - a12
        r2 = l1 * l1 + l3 * l3 + b13 * l1 * l3 - a13
        r3 = l2 * l2 + l3 * l3 + b23 * l2 * l3 - a23
        if abs(r1) + abs(r2) + abs(r3) < 1e-12 * (a12 + a13 + a23):
            return
        d11, d12 = 2.0 * l1 + b12 * l2, 2.0 * l2 + b12 * l1
        d21, d23 = 2.0 * l1 + b13 * l3, 2.0 * l3 + b13 * l1
        d32, d33 = 2.0 * l2 + b23 * l3, 2.0 * l3 + b23 * l2
        det = -d11 * d23 * d32 - d12 * d21 * d33
        if det == 0.0:
            return
        length[0] -= (-d23 * d32 * r1 - d12 * d33 * r2 + d12 * d23 * r3) / det
        length[1] -= (-d21 * d33 * r1 + d11 * d33 * r2 - d11 * d23 * r3) / det
        length[2] -= (d21 * d32 * r1 - d11 * d32 * r2 - d12 * d21 * r3) / det


@njit
def _frame(p: F64, q: F64, r: F64, out: F64) -> bool:
    """Right-handed axes (columns of out (3,3)) that hang on a triangle. False when it has no area."""
    x0, x1, x2 = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    y0, y1, y2 = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    n0, n1, n2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    lx = np.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    ln = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if lx < 1e-12 or ln < 1e-9 * lx * lx:
        return False
    x0, x1, x2 = x0 / lx, x1 / lx, x2 / lx
    n0, n1, n2 = n0 / ln, n1 / ln, n2 / ln
    out[0, 0], out[1, 0], out[2, 0] = x0, x1, x2
    out[0, 1], out[1, 1], out[2, 1] = n1 * x2 - n2 * x1, n2 * x0 - n0 * x2, n0 * x1 - n1 * x0
    out[0, 2], out[1, 2], out[2, 2] = n0, n1, n2
    return True


@njit
def p3p(ray: F64, point: F64, T: F64) -> int:
    """Poses that put three points on three rays (M. Persson, K. Nordberg, "Lambda Twist", 2018).

    ray: (3,3) unit vectors in the camera, one a row. point: (3,3) m in the map. T: (4,4,4) out: T_c_m of each
    solution. Returns how many there are, 0 to 4.
    """
    b12 = -2.0 * (ray[0, 0] * ray[1, 0] + ray[0, 1] * ray[1, 1] + ray[0, 2] * ray[1, 2])
    b13 = -2.0 * (ray[0, 0] * ray[2, 0] + ray[0, 1] * ray[2, 1] + ray[0, 2] * ray[2, 2])
    b23 = -2.0 * (ray[1, 0] * ray[2, 0] + ray[1, 1] * ray[2, 1] + ray[1, 2] * ray[2, 2])
    a12, a13, a23 = 0.0, 0.0, 0.0
    for k in range(3):
        a12 += (point[0, k] - point[1, k]) ** 2
        a13 += (point[0, k] - point[2, k]) ** 2
        a23 += (point[1, k] - point[2, k]) ** 2
    axes_m = np.empty((3, 3))
    if not _frame(point[0], point[1], point[2], axes_m):
        return 0
    # One conic of the pencil spanned by the two distance ratios degenerates: its parameter g is a root of a cubic.
    c12, c31, c23 = -0.5 * b12, -0.5 * b13, -0.5 * b23
    blob = c12 * c23 * c31 - 1.0
    s12, s31, s23 = 1.0 - c12 * c12, 1.0 - c31 * c31, 1.0 - c23 * c23
    p3 = a13 * (a23 * s31 - a13 * s23)
    p2 = 2.0 * blob * a23 * a13 + a13 * (2.0 * a12 + a13) * s23 + a23 * (a23 - a12) * s31
    p1 = a23 * (a13 - a23) * s12 - a12 * a12 * s23 - 2.0 * a12 * (blob * a23 + a13 * s23)
    p0 = a12 * (a12 * s23 - a23 * s12)
    if p3 == 0.0:
        return 0
    g = _real_cubic_root(p2 / p3, p1 / p3, p0 / p3)
    x00, x01, x02 = a23 * (1.0 - g), a23 * b12 * 0.5, -a23 * b13 * g * 0.5
    x11, x12, x22 = a23 - a12 + a13 * g, b23 * (a13 * g - a12) * 0.5, g * (a13 - a23) - a12
    # Its two eigenvalues that are not 0 give the two lines.
    b = -x00 - x11 - x22
    c = -x01 * x01 - x02 * x02 - x12 * x12 + x00 * (x11 + x22) + x11 * x22
    root = b * b - 4.0 * c
    if root < 0.0:
        root = 0.0
    root = np.sqrt(root)
    e1 = 0.5 * (-b + root) if b < 0.0 else 0.5 * (-b - root)
    e2 = -b - e1
    if abs(e1) < abs(e2):
        e1, e2 = e2, e1
    if e1 == 0.0:
        return 0
    v = np.empty((2, 3))
    for k in range(2):
        e = e1 if k == 0 else e2
        below = e * (x00 + x11) - x00 * x11 - e * e + x01 * x01
        if below == 0.0:
            return 0
        u0 = -(e * x02 + x01 * x12 - x02 * x11) / below
        u1 = -(e * x12 + x01 * x02 - x00 * x12) / below
        scale = 1.0 / np.sqrt(u0 * u0 + u1 * u1 + 1.0)
        v[k, 0], v[k, 1], v[k, 2] = u0 * scale, u1 * scale, scale
    slope = np.sqrt(max(0.0, -e2 / e1))
    length, seen, axes_c = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    n = 0
    for side in range(2):
        s = slope if side == 0 else -slope
        below = s * v[1, 0] - v[0, 0]
        if below == 0.0:
            continue
        w0, w1 = (v[0, 1] - s * v[1, 1]) / below, (v[0, 2] - s * v[1, 2]) / below
        below = (a13 - a12) * w1 * w1 - a12 * b13 * w1 - a12
        if below == 0.0:
            continue
        qb = (a13 * b12 * w1 - a12 * b13 * w0 - 2.0 * w0 * w1 * (a12 - a13)) / below
        qc = ((a13 - a12) * w0 * w0 + a13 * b12 * w0 + a13) / below
        root = qb * qb - 4.0 * qc
        if root < 0.0:
            continue
        root = np.sqrt(root)
        t1 = 0.5 * (-qb + root) if qb < 0.0 else 0.5 * (-qb - root)
        for k in range(2):
            tau = t1 if k == 0 else (qc / t1 if t1 != 0.0 else 0.0)
            if tau <= 0.0 or n == 4:
                continue
            below = tau * (b23 + tau) + 1.0
            if below <= 0.0:
                continue
            length[1] = np.sqrt(a23 / below)
            length[2] = tau * length[1]
            length[0] = w0 * length[1] + w1 * length[2]
            if length[0] <= 0.0:
                continue
            _polish(length, a12, a13, a23, b12, b13, b23)
            for i in range(3):
                for j in range(3):
                    seen[i, j] = length[i] * ray[i, j]
            if not _frame(seen[0], seen[1], seen[2], axes_c):
                continue
            for i in range(3):
                T[n, i, 3] = seen[0, i]
                for j in range(3):
                    T[n, i, j] = 0.0
                    for m in range(3):
                        T[n, i, j] += axes_c[i, m] * axes_m[j, m]
                for j in range(3):
                    T[n, i, 3] -= T[n, i, j] * point[0, j]
            T[n, 3, 0], T[n, 3, 1], T[n, 3, 2], T[n, 3, 3] = 0.0, 0.0, 0.0, 1.0
            n += 1
    return n


@njit
def _reprojection_cost(T: F64, point: F64, uv: F64, limit_px: F64, camera: F64, give_up: float) -> float:
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


@njit
def _mark_inliers(T: F64, point: F64, uv: F64, limit_px: F64, camera: F64, inlier: Bools) -> int:
    count = 0
    for i in range(point.shape[0]):
        one = _reprojection_cost(T, point[i : i + 1], uv[i : i + 1], limit_px[i : i + 1], camera, 2.0)
        inlier[i] = one < 1.0
        count += inlier[i]
    return count


@njit
def _draws_needed(share: float, confidence: float, most: int) -> int:
    """Draws of three after which one without outliers has come with the given confidence."""
    bad = 1.0 - share * share * share
    if bad <= 0.0:
        return 1
    if bad >= 1.0:
        return most
    return min(most, int(np.log(1.0 - confidence) / np.log(bad)) + 1)


@njit
def _three(state: U64, n: int, pick: I64) -> None:
    pick[0] = draw(state, n)
    pick[1] = draw(state, n - 1)
    if pick[1] >= pick[0]:
        pick[1] += 1
    pick[2] = draw(state, n - 2)
    if pick[2] >= min(pick[0], pick[1]):
        pick[2] += 1
    if pick[2] >= max(pick[0], pick[1]):
        pick[2] += 1


@njit
def p3p_ransac(
    point: F64, uv: F64, limit_px: F64, camera: F64, most_draws: int, confidence: float, state: U64, T_c_m: F64,
    inlier: Bools,
) -> int:  # fmt: skip
    """The pose of most support over random triples. point: (n,3) m, n >= 3. uv: (n,2) px. limit_px: (n,) of an inlier.

    camera: fx, fy, cx, cy. state: (1,) uint64 seed, in and out. T_c_m: (4,4) out. inlier: (n,) out. Returns how many
    inliers; 0 when no triple has a pose.
    """
    n = point.shape[0]
    pick = np.empty(3, np.int64)
    ray, corner = np.empty((3, 3)), np.empty((3, 3))
    found = np.empty((4, 4, 4))
    least = float(n)
    count, needed, k = 0, most_draws, 0
    while k < needed:
        k += 1
        _three(state, n, pick)
        for i in range(3):
            x, y = (uv[pick[i], 0] - camera[2]) / camera[0], (uv[pick[i], 1] - camera[3]) / camera[1]
            norm = np.sqrt(x * x + y * y + 1.0)
            ray[i, 0], ray[i, 1], ray[i, 2] = x / norm, y / norm, 1.0 / norm
            for j in range(3):
                corner[i, j] = point[pick[i], j]
        for s in range(p3p(ray, corner, found)):
            cost = _reprojection_cost(found[s], point, uv, limit_px, camera, least)
            if cost < least:
                least = cost
                T_c_m[:] = found[s]
                count = _mark_inliers(T_c_m, point, uv, limit_px, camera, inlier)
                needed = _draws_needed(count / n, confidence, most_draws)
    if count == 0:
        inlier[:] = False
    return count


@njit
def align_points(a: F64, b: F64, chosen: Bools, with_scale: bool, S_a_b: F64) -> bool:
    """Least-squares similarity a = S_a_b b over the chosen rows (B. Horn, 1987; scale symmetric in a and b).

    a, b: (n,3). S_a_b: (4,4) out, its upper left part scale times rotation. False when the points leave it open.
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
    if spread_a < 1e-18 or spread_b < 1e-18:
        return False
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
    """Unit eigenvector of the largest eigenvalue of a symmetric (4,4), by Jacobi rotations. False when two tie."""
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
def align_ransac(
    a: F64, uv_a: F64, limit_a_px: F64, camera_a: F64, b: F64, uv_b: F64, limit_b_px: F64, camera_b: F64,
    with_scale: bool, most_draws: int, confidence: float, state: U64, S_a_b: F64, inlier: Bools,
) -> int:  # fmt: skip
    """The similarity between two views' points that most pairs support, in both images.

    a, b: (n,3) m in either camera, n >= 3. uv_*: (n,2) px at which each is seen there. limit_*_px: (n,). camera_*: fx,
    fy, cx, cy. state: (1,) uint64 seed, in and out. S_a_b: (4,4) out. inlier: (n,) out: the pair reprojects within the
    limits both ways. Returns how many inliers, 0 for none.
    """
    n = a.shape[0]
    pick = np.empty(3, np.int64)
    three_a, three_b, all3 = np.empty((3, 3)), np.empty((3, 3)), np.ones(3, np.bool_)
    S, back = np.empty((4, 4)), np.empty((4, 4))
    mine = np.empty(n, np.bool_)
    count, needed, k = 0, most_draws, 0
    while k < needed:
        k += 1
        _three(state, n, pick)
        for i in range(3):
            for j in range(3):
                three_a[i, j], three_b[i, j] = a[pick[i], j], b[pick[i], j]
        if not align_points(three_a, three_b, all3, with_scale, S):
            continue
        _invert(S, back)
        support = _mark_pairs(S, back, a, uv_a, limit_a_px, camera_a, b, uv_b, limit_b_px, camera_b, mine)
        if support <= count:
            continue
        # Every new best is fitted to its support, as long as that grows it.
        while support > count:
            count = support
            S_a_b[:] = S
            inlier[:] = mine
            if not align_points(a, b, inlier, with_scale, S):
                break
            _invert(S, back)
            support = _mark_pairs(S, back, a, uv_a, limit_a_px, camera_a, b, uv_b, limit_b_px, camera_b, mine)
        if support == count:
            S_a_b[:] = S
            inlier[:] = mine
        needed = _draws_needed(count / n, confidence, most_draws)
    if count == 0:
        inlier[:] = False
    return count


@njit
def _mark_pairs(
    S: F64, back: F64, a: F64, uv_a: F64, limit_a: F64, camera_a: F64, b: F64, uv_b: F64, limit_b: F64, camera_b: F64,
    inlier: Bools,
) -> int:  # fmt: skip
    count = 0
    for i in range(a.shape[0]):
        one = slice(i, i + 1)
        inlier[i] = (
            _reprojection_cost(S, b[one], uv_a[one], limit_a[one], camera_a, 2.0) < 1.0
            and _reprojection_cost(back, a[one], uv_b[one], limit_b[one], camera_b, 2.0) < 1.0
        )
        count += inlier[i]
    return count

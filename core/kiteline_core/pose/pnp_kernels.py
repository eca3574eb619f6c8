"""Kernels of P3P in a RANSAC seeded by the caller."""

import numpy as np

from kiteline_core.arrays import F64, U64, Bool
from kiteline_core.jit import helper, njit
from kiteline_core.pose.ransac_kernels import draws_needed, reprojection_cost, three


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
    """Right-handed axes of a triangle as columns of out (3,3). False if it has no area."""
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


@helper
def p3p(ray: F64, point: F64, T: F64) -> int:
    """Poses that project three points onto three rays (M. Persson, K. Nordberg, "Lambda Twist", 2018).

    ray: (3,3) unit vectors in the camera, one a row. point: (3,3) m in the map. T: (4,4,4) out: T_c_m of each
    solution. Returns their number, 0 to 4.
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
    # The degenerate conic of the pencil spanned by the two distance ratios: its parameter g is a root of a cubic.
    c12, c31, c23 = -0.5 * b12, -0.5 * b13, -0.5 * b23
    cross_term = c12 * c23 * c31 - 1.0
    s12, s31, s23 = 1.0 - c12 * c12, 1.0 - c31 * c31, 1.0 - c23 * c23
    p3 = a13 * (a23 * s31 - a13 * s23)
    p2 = 2.0 * cross_term * a23 * a13 + a13 * (2.0 * a12 + a13) * s23 + a23 * (a23 - a12) * s31
    p1 = a23 * (a13 - a23) * s12 - a12 * a12 * s23 - 2.0 * a12 * (cross_term * a23 + a13 * s23)
    p0 = a12 * (a12 * s23 - a23 * s12)
    if p3 == 0.0:
        return 0
    g = _real_cubic_root(p2 / p3, p1 / p3, p0 / p3)
    x00, x01, x02 = a23 * (1.0 - g), a23 * b12 * 0.5, -a23 * b13 * g * 0.5
    x11, x12, x22 = a23 - a12 + a13 * g, b23 * (a13 * g - a12) * 0.5, g * (a13 - a23) - a12
    # Its two nonzero eigenvalues give the two lines.
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
def _mark_inliers(T: F64, point: F64, uv: F64, limit_px: F64, camera: F64, inlier: Bool) -> int:
    count = 0
    for i in range(point.shape[0]):
        one = reprojection_cost(T, point[i : i + 1], uv[i : i + 1], limit_px[i : i + 1], camera, 2.0)
        inlier[i] = one < 1.0
        count += inlier[i]
    return count


@njit
def p3p_ransac(
    point: F64, uv: F64, limit_px: F64, camera: F64, most_draws: int, confidence: float, state: U64, T_c_m: F64,
    inlier: Bool,
) -> int:  # fmt: skip
    """The pose of least cost over random triples. point: (n,3) m, n >= 3. uv: (n,2) px. limit_px: (n,) of an inlier.

    camera: fx, fy, cx, cy. state: (1,) uint64 seed, in and out. T_c_m: (4,4) out. inlier: (n,) out. Returns the
    number of inliers.
    """
    n = point.shape[0]
    pick = np.empty(3, np.int64)
    ray, corner = np.empty((3, 3)), np.empty((3, 3))
    found = np.empty((4, 4, 4))
    least = float(n)
    count, needed, k = 0, most_draws, 0
    while k < needed:
        k += 1
        three(state, n, pick)
        for i in range(3):
            x, y = (uv[pick[i], 0] - camera[2]) / camera[0], (uv[pick[i], 1] - camera[3]) / camera[1]
            norm = np.sqrt(x * x + y * y + 1.0)
            ray[i, 0], ray[i, 1], ray[i, 2] = x / norm, y / norm, 1.0 / norm
            for j in range(3):
                corner[i, j] = point[pick[i], j]
        for s in range(p3p(ray, corner, found)):
            cost = reprojection_cost(found[s], point, uv, limit_px, camera, least)
            if cost < least:
                least = cost
                for i in range(4):
                    for j in range(4):
                        T_c_m[i, j] = found[s, i, j]
                count = _mark_inliers(T_c_m, point, uv, limit_px, camera, inlier)
                needed = draws_needed(count / n, confidence, most_draws)
    if count == 0:
        for i in range(n):
            inlier[i] = False
    return count

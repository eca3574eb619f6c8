"""Kernels of bundle adjustment: poses and points from robust pixel and disparity residuals, by the Schur complement.

Arrays throughout: cameras (k,12) = rotation row by row and translation of T_c_m; lens (k,5) = fx fy cx cy bf; points
(n,3) in m; observations sorted by point, inside a point by camera: starts (n + 1,), camera (m,), measured (m,3) = u, v,
disparity (negative: none) in px, weight (m,2) = 1/sigma^2 of pixel and disparity, active (m,) uint8. free (k,):
index of each camera among the free ones, increasing, -1 for a fixed camera. A camera step is T_c_m <- Exp(d) T_c_m with
d = [translation, rotation].
"""

import numpy as np

from kiteline_core.jit import njit

NEAR_M = 0.02  # least depth of a point with an image
BEHIND = 1.0e12  # squared residual of an observation without an image, so that no step leads there


@njit
def _residual(cameras, c, lens, points, i, measured, weight, o):  # type: ignore[no-untyped-def]
    """Observation o of point i by camera c: squared norm, residuals, point in the camera, has an image."""
    p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
    x = cameras[c, 0] * p0 + cameras[c, 1] * p1 + cameras[c, 2] * p2 + cameras[c, 9]
    y = cameras[c, 3] * p0 + cameras[c, 4] * p1 + cameras[c, 5] * p2 + cameras[c, 10]
    d = cameras[c, 6] * p0 + cameras[c, 7] * p1 + cameras[c, 8] * p2 + cameras[c, 11]
    if d < NEAR_M:
        return BEHIND, 0.0, 0.0, 0.0, x, y, d, False
    inv = 1.0 / d
    r0 = lens[c, 0] * x * inv + lens[c, 2] - measured[o, 0]
    r1 = lens[c, 1] * y * inv + lens[c, 3] - measured[o, 1]
    r2 = 0.0
    s = weight[o, 0] * (r0 * r0 + r1 * r1)
    if measured[o, 2] >= 0.0:
        r2 = lens[c, 4] * inv - measured[o, 2]
        s += weight[o, 1] * r2 * r2
    return s, r0, r1, r2, x, y, d, True


@njit
def squared_residuals(cameras, lens, points, starts, camera, measured, weight, out):  # type: ignore[no-untyped-def]
    """Squared normalised residual (m,) of every observation, active or not; BEHIND without an image."""
    for i in range(points.shape[0]):
        for o in range(starts[i], starts[i + 1]):
            out[o] = _residual(cameras, camera[o], lens, points, i, measured, weight, o)[0]


@njit
def robust_cost(cameras, lens, points, starts, camera, measured, weight, active, bound):  # type: ignore[no-untyped-def]
    """Sum of Huber costs of the active observations. bound: (2,) squared residual without, with a disparity."""
    total = 0.0
    for i in range(points.shape[0]):
        for o in range(starts[i], starts[i + 1]):
            if active[o] == 0:
                continue
            s = _residual(cameras, camera[o], lens, points, i, measured, weight, o)[0]
            b = bound[1] if measured[o, 2] >= 0.0 else bound[0]
            total += s if s <= b else 2.0 * np.sqrt(b * s) - b
    return total


@njit
def linearise(  # type: ignore[no-untyped-def]
    cameras, lens, points, starts, camera, measured, weight, active, bound, free, hcc, bc, hpp, bp, hcp
):
    """Blocks of the normal equations at the present estimate; returns the robust cost.

    hcc (f,6,6) upper triangle, bc (f,6), hpp (n,6) = xx xy xz yy yz zz, bp (n,3), hcp (m,6,3): filled from nothing.
    """
    for f in range(bc.shape[0]):
        for a in range(6):
            bc[f, a] = 0.0
            for b in range(6):
                hcc[f, a, b] = 0.0
    total = 0.0
    jc = np.zeros((3, 6))
    jp = np.zeros((3, 3))
    for i in range(points.shape[0]):
        h0 = h1 = h2 = h3 = h4 = h5 = 0.0
        b0 = b1 = b2 = 0.0
        for o in range(starts[i], starts[i + 1]):
            if active[o] == 0:
                continue
            c = camera[o]
            s, e0, e1, e2, x, y, d, seen = _residual(cameras, c, lens, points, i, measured, weight, o)
            bnd = bound[1] if measured[o, 2] >= 0.0 else bound[0]
            robust = 1.0
            if s > bnd:
                total += 2.0 * np.sqrt(bnd * s) - bnd
                robust = np.sqrt(bnd / s)
            else:
                total += s
            if not seen:
                for a in range(6):
                    for b in range(3):
                        hcp[o, a, b] = 0.0
                continue
            inv = 1.0 / d
            g00, g02 = lens[c, 0] * inv, -lens[c, 0] * x * inv * inv
            g11, g12 = lens[c, 1] * inv, -lens[c, 1] * y * inv * inv
            g22 = -lens[c, 4] * inv * inv
            rows = 3 if measured[o, 2] >= 0.0 else 2
            # by translation: the projection's own gradient; by rotation: that gradient times -[p]x
            jc[0, 0], jc[0, 1], jc[0, 2] = g00, 0.0, g02
            jc[1, 0], jc[1, 1], jc[1, 2] = 0.0, g11, g12
            jc[2, 0], jc[2, 1], jc[2, 2] = 0.0, 0.0, g22
            jc[0, 3], jc[0, 4], jc[0, 5] = g02 * y, g00 * d - g02 * x, -g00 * y
            jc[1, 3], jc[1, 4], jc[1, 5] = -g11 * d + g12 * y, -g12 * x, g11 * x
            jc[2, 3], jc[2, 4], jc[2, 5] = g22 * y, -g22 * x, 0.0
            for k in range(3):
                jp[0, k] = g00 * cameras[c, k] + g02 * cameras[c, 6 + k]
                jp[1, k] = g11 * cameras[c, 3 + k] + g12 * cameras[c, 6 + k]
                jp[2, k] = g22 * cameras[c, 6 + k]
            w0 = robust * weight[o, 0]
            w2 = robust * weight[o, 1] if rows == 3 else 0.0
            h0 += w0 * (jp[0, 0] * jp[0, 0] + jp[1, 0] * jp[1, 0]) + w2 * jp[2, 0] * jp[2, 0]
            h1 += w0 * (jp[0, 0] * jp[0, 1] + jp[1, 0] * jp[1, 1]) + w2 * jp[2, 0] * jp[2, 1]
            h2 += w0 * (jp[0, 0] * jp[0, 2] + jp[1, 0] * jp[1, 2]) + w2 * jp[2, 0] * jp[2, 2]
            h3 += w0 * (jp[0, 1] * jp[0, 1] + jp[1, 1] * jp[1, 1]) + w2 * jp[2, 1] * jp[2, 1]
            h4 += w0 * (jp[0, 1] * jp[0, 2] + jp[1, 1] * jp[1, 2]) + w2 * jp[2, 1] * jp[2, 2]
            h5 += w0 * (jp[0, 2] * jp[0, 2] + jp[1, 2] * jp[1, 2]) + w2 * jp[2, 2] * jp[2, 2]
            r0, r1, r2 = w0 * e0, w0 * e1, w2 * e2
            b0 -= jp[0, 0] * r0 + jp[1, 0] * r1 + jp[2, 0] * r2
            b1 -= jp[0, 1] * r0 + jp[1, 1] * r1 + jp[2, 1] * r2
            b2 -= jp[0, 2] * r0 + jp[1, 2] * r1 + jp[2, 2] * r2
            f = free[c]
            if f < 0:
                continue
            for a in range(6):
                ja0, ja1, ja2 = w0 * jc[0, a], w0 * jc[1, a], w2 * jc[2, a]
                bc[f, a] -= jc[0, a] * r0 + jc[1, a] * r1 + jc[2, a] * r2
                for b in range(a, 6):
                    hcc[f, a, b] += ja0 * jc[0, b] + ja1 * jc[1, b] + ja2 * jc[2, b]
                for b in range(3):
                    hcp[o, a, b] = ja0 * jp[0, b] + ja1 * jp[1, b] + ja2 * jp[2, b]
        hpp[i, 0], hpp[i, 1], hpp[i, 2], hpp[i, 3], hpp[i, 4], hpp[i, 5] = h0, h1, h2, h3, h4, h5
        bp[i, 0], bp[i, 1], bp[i, 2] = b0, b1, b2
    return total


@njit
def reduce(starts, camera, active, free, damping, hcc, bc, hpp, bp, hcp, inv, s, rhs):  # type: ignore[no-untyped-def]
    """Eliminate the points from the normal equations: upper triangle of s (6f,6f) and rhs (6f,).

    Diagonals are damped by the factor 1 + damping (Marquardt). inv (n,6): the inverted point blocks. Returns the number
    of pairs of observations that were combined.
    """
    for a in range(s.shape[0]):
        for b in range(s.shape[1]):
            s[a, b] = 0.0
    for f in range(hcc.shape[0]):
        for a in range(6):
            rhs[6 * f + a] = bc[f, a]
            for b in range(a, 6):
                s[6 * f + a, 6 * f + b] = hcc[f, a, b]
            s[6 * f + a, 6 * f + a] = hcc[f, a, a] * (1.0 + damping) + 1e-9
    y = np.empty((6, 3))
    pairs = 0
    for i in range(starts.shape[0] - 1):
        m0 = hpp[i, 0] * (1.0 + damping) + 1e-9
        m3 = hpp[i, 3] * (1.0 + damping) + 1e-9
        m5 = hpp[i, 5] * (1.0 + damping) + 1e-9
        m1, m2, m4 = hpp[i, 1], hpp[i, 2], hpp[i, 4]
        c0, c1, c2 = m3 * m5 - m4 * m4, m2 * m4 - m1 * m5, m1 * m4 - m2 * m3
        det = m0 * c0 + m1 * c1 + m2 * c2
        if det <= 1e-30 * m0 * m3 * m5 or det <= 0.0:
            for a in range(6):
                inv[i, a] = 0.0  # a point that nothing holds: it stays where it is
            continue
        q = 1.0 / det
        v0, v1, v2 = c0 * q, c1 * q, c2 * q
        v3, v4, v5 = (m0 * m5 - m2 * m2) * q, (m1 * m2 - m0 * m4) * q, (m0 * m3 - m1 * m1) * q
        inv[i, 0], inv[i, 1], inv[i, 2], inv[i, 3], inv[i, 4], inv[i, 5] = v0, v1, v2, v3, v4, v5
        for o in range(starts[i], starts[i + 1]):
            if active[o] == 0 or free[camera[o]] < 0:
                continue
            f = 6 * free[camera[o]]
            for a in range(6):
                w0, w1, w2 = hcp[o, a, 0], hcp[o, a, 1], hcp[o, a, 2]
                y0 = w0 * v0 + w1 * v1 + w2 * v2
                y1 = w0 * v1 + w1 * v3 + w2 * v4
                y2 = w0 * v2 + w1 * v4 + w2 * v5
                y[a, 0], y[a, 1], y[a, 2] = y0, y1, y2
                rhs[f + a] -= y0 * bp[i, 0] + y1 * bp[i, 1] + y2 * bp[i, 2]
            for k in range(o, starts[i + 1]):
                if active[k] == 0 or free[camera[k]] < 0:
                    continue
                pairs += 1
                g = 6 * free[camera[k]]
                for a in range(6):
                    y0, y1, y2 = y[a, 0], y[a, 1], y[a, 2]
                    for b in range(6):
                        s[f + a, g + b] -= y0 * hcp[k, b, 0] + y1 * hcp[k, b, 1] + y2 * hcp[k, b, 2]
    return pairs


@njit
def solve(s, x):  # type: ignore[no-untyped-def]
    """Solve s x = b for a symmetric s given by its upper triangle; b comes in x (n,). s is overwritten by its factor.

    Right-looking Cholesky over rows that skips zeros, so that a chain of keyframes costs its band only. Returns False
    when s is not positive definite.
    """
    n = s.shape[0]
    last = np.empty(n, np.int64)  # end of the non-zero part of each row
    for j in range(n):
        e = n
        while e > j + 1 and s[j, e - 1] == 0.0:
            e -= 1
        last[j] = e
    for j in range(n):
        if not s[j, j] > 1e-12:
            return False
        d = 1.0 / np.sqrt(s[j, j])
        e = last[j]
        for k in range(j, e):
            s[j, k] *= d
        pivot = s[j]
        for i in range(j + 1, e):
            u = pivot[i]
            if u == 0.0:
                continue
            line = s[i]
            for k in range(i, e):
                line[k] -= u * pivot[k]
            if last[i] < e:
                last[i] = e
    for j in range(n):
        x[j] /= s[j, j]
        v = x[j]
        for k in range(j + 1, last[j]):
            x[k] -= s[j, k] * v
    for j in range(n - 1, -1, -1):
        v = x[j]
        for k in range(j + 1, last[j]):
            v -= s[j, k] * x[k]
        x[j] = v / s[j, j]
    return True


@njit
def step(  # type: ignore[no-untyped-def]
    cameras, points, starts, camera, active, free, inv, bp, hcp, dx, new_cameras, new_points
):
    """Apply a camera step dx (6f,) and the resulting point steps."""
    r = np.empty((3, 3))
    for c in range(cameras.shape[0]):
        f = free[c]
        if f < 0:
            for a in range(12):
                new_cameras[c, a] = cameras[c, a]
            continue
        d = dx[6 * f : 6 * f + 6]
        _rotation(d[3], d[4], d[5], r)
        for a in range(3):
            for b in range(3):
                v = 0.0
                for k in range(3):
                    v += r[a, k] * cameras[c, 3 * k + b]
                new_cameras[c, 3 * a + b] = v
            new_cameras[c, 9 + a] = (
                r[a, 0] * cameras[c, 9] + r[a, 1] * cameras[c, 10] + r[a, 2] * cameras[c, 11] + d[a]
            )  # fmt: skip
    for i in range(points.shape[0]):
        b0, b1, b2 = bp[i, 0], bp[i, 1], bp[i, 2]
        for o in range(starts[i], starts[i + 1]):
            f = free[camera[o]]
            if active[o] == 0 or f < 0:
                continue
            for a in range(6):
                v = dx[6 * f + a]
                b0 -= hcp[o, a, 0] * v
                b1 -= hcp[o, a, 1] * v
                b2 -= hcp[o, a, 2] * v
        new_points[i, 0] = points[i, 0] + inv[i, 0] * b0 + inv[i, 1] * b1 + inv[i, 2] * b2
        new_points[i, 1] = points[i, 1] + inv[i, 1] * b0 + inv[i, 3] * b1 + inv[i, 4] * b2
        new_points[i, 2] = points[i, 2] + inv[i, 2] * b0 + inv[i, 4] * b1 + inv[i, 5] * b2


@njit
def _rotation(x, y, z, r):  # type: ignore[no-untyped-def]
    """Rodrigues' formula into r (3,3)."""
    q = x * x + y * y + z * z
    angle = np.sqrt(q)
    if angle < 1e-6:
        a, b = 1.0 - q / 6.0, 0.5 - q / 24.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / q
    r[0, 0], r[0, 1], r[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    r[1, 0], r[1, 1], r[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    r[2, 0], r[2, 1], r[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)

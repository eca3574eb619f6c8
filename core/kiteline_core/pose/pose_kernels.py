"""Motion-only optimisation: the camera pose from known points, robust, with the points' own uncertainty."""

from __future__ import annotations

import numpy as np

from kiteline_core.jit import njit

_STILL = 1e-8  # square of a step, in m and rad, after which the next would be a thousandth of it


@njit
def _exp(xi, r, t):  # type: ignore[no-untyped-def]
    """Rotation and translation of a tangent vector [translation, rotation]; see se3.exp."""
    wx, wy, wz = xi[3], xi[4], xi[5]
    angle2 = wx * wx + wy * wy + wz * wz
    angle = np.sqrt(angle2)
    if angle < 1e-5:
        a, b, c = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0
    else:
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle2
        c = (angle - np.sin(angle)) / (angle2 * angle)
    k = np.zeros((3, 3))
    k[0, 1], k[0, 2] = -wz, wy
    k[1, 0], k[1, 2] = wz, -wx
    k[2, 0], k[2, 1] = -wy, wx
    k2 = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for m in range(3):
                k2[i, j] += k[i, m] * k[m, j]
    for i in range(3):
        t[i] = 0.0
        for j in range(3):
            eye = 1.0 if i == j else 0.0
            r[i, j] = eye + a * k[i, j] + b * k2[i, j]
            t[i] += (eye + b * k[i, j] + c * k2[i, j]) * xi[j]


@njit
def _solve6(h, g, x):  # type: ignore[no-untyped-def]
    """Cholesky solution of the 6x6 system h x = g, in place of h. Returns False when h is not positive definite."""
    for j in range(6):
        s = h[j, j]
        for k in range(j):
            s -= h[j, k] * h[j, k]
        if s <= 1e-12:
            return False
        d = np.sqrt(s)
        h[j, j] = d
        for i in range(j + 1, 6):
            s = h[i, j]
            for k in range(j):
                s -= h[i, k] * h[j, k]
            h[i, j] = s / d
    for i in range(6):
        s = g[i]
        for k in range(i):
            s -= h[i, k] * x[k]
        x[i] = s / h[i, i]
    for i in range(5, -1, -1):
        s = x[i]
        for k in range(i + 1, 6):
            s -= h[k, i] * x[k]
        x[i] = s / h[i, i]
    return True


@njit
def optimise_pose(  # type: ignore[no-untyped-def]
    T_c_m, points, depth_ray, observed, sigma_px, camera, prior, prior_weight, rounds, iterations, chi2, inlier, h_out
):
    """Gauss-Newton with Huber weights; after each round outliers leave (or come back), as in ORB-SLAM2 section V.

    T_c_m: (4,4) pose, start in, result out. points: (n,3) m. depth_ray: (n,3) one standard deviation of the point along
    the ray on which it hangs, in m; zeros for well-known points. observed: (n,3) u, v, disparity px (< 0: none).
    sigma_px: (n,) of one coordinate. camera: fx, fy, cx, cy, bf. prior: (4,4) predicted T_c_m; prior_weight: (6,)
    information of its error [translation 1/m^2, rotation 1/rad^2], zeros for none. chi2: threshold of squared whitened
    error for 2 measurements; 3 measurements use chi2 * 1.3. inlier: (n,) bool, in and out.
    h_out: (6,6) information of the result, out. Returns (number of inliers, rms of their whitened error).
    """
    fx, fy, cx, cy, bf = camera[0], camera[1], camera[2], camera[3], camera[4]
    n = points.shape[0]
    h = np.zeros((6, 6))
    g = np.zeros(6)
    step = np.zeros(6)
    jac = np.zeros((3, 6))
    res = np.zeros(3)
    v = np.zeros(3)
    jv = np.zeros(6)
    dr = np.zeros((3, 3))
    dt = np.zeros(3)
    count = 0
    total = 0.0
    for _round in range(rounds):
        for _iteration in range(iterations):
            for a in range(6):
                g[a] = 0.0
                for b in range(6):
                    h[a, b] = 0.0
            for i in range(n):
                if not inlier[i]:
                    continue
                ok = _point_terms(
                    T_c_m, points[i], depth_ray[i], observed[i], sigma_px[i], fx, fy, cx, cy, bf, jac, res, v
                )
                if not ok:
                    continue
                rows = 3 if observed[i, 2] >= 0.0 else 2
                s2 = sigma_px[i] * sigma_px[i]
                vv = s2
                rv = 0.0
                rr = 0.0
                for k in range(rows):
                    vv += v[k] * v[k]
                    rv += res[k] * v[k]
                    rr += res[k] * res[k]
                e2 = (rr - rv * rv / vv) / s2
                limit = chi2 if rows == 2 else chi2 * 1.3
                weight = 1.0 / s2
                if e2 > limit * 0.5:
                    weight *= np.sqrt(limit * 0.5 / e2)
                for a in range(6):
                    s = 0.0
                    for k in range(rows):
                        s += jac[k, a] * v[k]
                    jv[a] = s
                for a in range(6):
                    s = 0.0
                    for k in range(rows):
                        s += jac[k, a] * res[k]
                    g[a] -= weight * (s - jv[a] * rv / vv)
                    for b in range(a + 1):
                        s = 0.0
                        for k in range(rows):
                            s += jac[k, a] * jac[k, b]
                        h[a, b] += weight * (s - jv[a] * jv[b] / vv)
            # prior on the pose: error of T_c_m * prior^-1, first order
            if prior_weight[0] > 0.0 or prior_weight[3] > 0.0:
                for a in range(3):
                    s = T_c_m[a, 3]
                    for b in range(3):
                        rot = 0.0
                        for k in range(3):
                            rot += T_c_m[a, k] * prior[b, k]
                        dr[a, b] = rot
                        s -= rot * prior[b, 3]
                    dt[a] = s
                g[0] -= prior_weight[0] * dt[0]
                g[1] -= prior_weight[1] * dt[1]
                g[2] -= prior_weight[2] * dt[2]
                g[3] -= prior_weight[3] * 0.5 * (dr[2, 1] - dr[1, 2])
                g[4] -= prior_weight[4] * 0.5 * (dr[0, 2] - dr[2, 0])
                g[5] -= prior_weight[5] * 0.5 * (dr[1, 0] - dr[0, 1])
                for a in range(6):
                    h[a, a] += prior_weight[a]
            for a in range(6):
                for b in range(a):
                    h[b, a] = h[a, b]
            for a in range(6):
                for b in range(6):
                    h_out[a, b] = h[a, b]
                h[a, a] += 1e-6
            if not _solve6(h, g, step):
                break
            _exp(step, dr, dt)
            _apply_left(dr, dt, T_c_m)
            norm = 0.0
            for a in range(6):
                norm += step[a] * step[a]
            if norm < _STILL:
                break
        count = 0
        total = 0.0
        for i in range(n):
            ok = _point_terms(T_c_m, points[i], depth_ray[i], observed[i], sigma_px[i], fx, fy, cx, cy, bf, jac, res, v)
            if not ok:
                inlier[i] = False
                continue
            rows = 3 if observed[i, 2] >= 0.0 else 2
            s2 = sigma_px[i] * sigma_px[i]
            vv = s2
            rv = 0.0
            rr = 0.0
            for k in range(rows):
                vv += v[k] * v[k]
                rv += res[k] * v[k]
                rr += res[k] * res[k]
            e2 = (rr - rv * rv / vv) / s2
            inlier[i] = e2 <= (chi2 if rows == 2 else chi2 * 1.3)
            if inlier[i]:
                count += 1
                total += e2 / rows
    return count, np.sqrt(total / max(count, 1))


@njit
def _apply_left(dr, dt, T):  # type: ignore[no-untyped-def]
    """T := [dr dt] T, in place."""
    for c in range(4):
        x, y, z = T[0, c], T[1, c], T[2, c]
        for a in range(3):
            T[a, c] = dr[a, 0] * x + dr[a, 1] * y + dr[a, 2] * z
    for a in range(3):
        T[a, 3] += dt[a]


@njit
def _point_terms(T, p, ray, obs, sigma, fx, fy, cx, cy, bf, jac, res, v):  # type: ignore[no-untyped-def]
    """Residual (predicted - observed), its Jacobian by a left perturbation of T, and its shift by `ray`."""
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    if z < 0.05:
        return False
    iz = 1.0 / z
    u = x * iz
    w = y * iz
    res[0] = fx * u + cx - obs[0]
    res[1] = fy * w + cy - obs[1]
    res[2] = bf * iz - obs[2]
    # d(u, v, disparity)/d(x, y, z)
    a0, a2 = fx * iz, -fx * u * iz
    b1, b2 = fy * iz, -fy * w * iz
    c2 = -bf * iz * iz
    jac[0, 0], jac[0, 1], jac[0, 2] = a0, 0.0, a2
    jac[1, 0], jac[1, 1], jac[1, 2] = 0.0, b1, b2
    jac[2, 0], jac[2, 1], jac[2, 2] = 0.0, 0.0, c2
    # left perturbation: dp = dt + w x p  ->  d/dw = -[p]x
    for k in range(3):
        j0, j1, j2 = jac[k, 0], jac[k, 1], jac[k, 2]
        jac[k, 3] = -j1 * z + j2 * y
        jac[k, 4] = j0 * z - j2 * x
        jac[k, 5] = -j0 * y + j1 * x
    rx = T[0, 0] * ray[0] + T[0, 1] * ray[1] + T[0, 2] * ray[2]
    ry = T[1, 0] * ray[0] + T[1, 1] * ray[1] + T[1, 2] * ray[2]
    rz = T[2, 0] * ray[0] + T[2, 1] * ray[1] + T[2, 2] * ray[2]
    v[0] = a0 * rx + a2 * rz
    v[1] = b1 * ry + b2 * rz
    v[2] = c2 * rz
    return True

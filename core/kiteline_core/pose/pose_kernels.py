"""Motion-only optimisation: the camera pose from known points, robust, with the points' own uncertainty."""

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
def solve6(h, g, x):  # type: ignore[no-untyped-def]
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
    T_c_m, points, depth_ray, observed, sigma_px, camera, rounds, iterations, chi2, inlier
):
    """Gauss-Newton with Huber weights; after each round outliers leave (or come back), as in ORB-SLAM2 section V.

    T_c_m: (4,4) pose, start in, result out. points: (n,3) m. depth_ray: (n,3) one standard deviation of the point along
    the ray on which it hangs, in m; zeros for well-known points. observed: (n,3) u, v, disparity px (< 0: none).
    sigma_px: (n,) of one coordinate. camera: fx, fy, cx, cy, bf. chi2: threshold of squared whitened error for 2
    measurements; 3 measurements use chi2 * 1.3. inlier: (n,) bool, in and out. Returns (number of inliers, rms of their
    whitened error).
    """
    fx, fy, cx, cy, bf = camera[0], camera[1], camera[2], camera[3], camera[4]
    n = points.shape[0]
    h = np.zeros((6, 6))
    g = np.zeros(6)
    step = np.zeros(6)
    dr = np.zeros((3, 3))
    dt = np.zeros(3)
    count = 0
    total = 0.0
    for turn in range(rounds + 1):
        final = turn == rounds
        for iteration in range(1 if final else iterations):
            # The first step of a round chooses the inliers anew; after the last round nothing else is left to do.
            judge = iteration == 0 and turn > 0
            if judge:
                count = 0
                total = 0.0
            for a in range(6):
                g[a] = 0.0
                for b in range(6):
                    h[a, b] = 0.0
            t00, t01, t02, t03 = T_c_m[0, 0], T_c_m[0, 1], T_c_m[0, 2], T_c_m[0, 3]
            t10, t11, t12, t13 = T_c_m[1, 0], T_c_m[1, 1], T_c_m[1, 2], T_c_m[1, 3]
            t20, t21, t22, t23 = T_c_m[2, 0], T_c_m[2, 1], T_c_m[2, 2], T_c_m[2, 3]
            for i in range(n):
                if not (judge or inlier[i]):
                    continue
                px, py, pz = points[i, 0], points[i, 1], points[i, 2]
                x = t00 * px + t01 * py + t02 * pz + t03
                y = t10 * px + t11 * py + t12 * pz + t13
                z = t20 * px + t21 * py + t22 * pz + t23
                if z < 0.05:
                    inlier[i] = inlier[i] and not judge
                    continue
                stereo = observed[i, 2] >= 0.0
                s2 = sigma_px[i] * sigma_px[i]
                inverse = 1.0 / z
                u = x * inverse
                w = y * inverse
                r0 = fx * u + cx - observed[i, 0]
                r1 = fy * w + cy - observed[i, 1]
                r2 = bf * inverse - observed[i, 2] if stereo else 0.0
                # d(u, v, disparity)/d(x, y, z) = a0 0 a2 | 0 b1 b2 | 0 0 c2, and the shift (v0, v1, v2) by the ray
                a0, a2 = fx * inverse, -fx * u * inverse
                b1, b2 = fy * inverse, -fy * w * inverse
                c2 = -bf * inverse * inverse if stereo else 0.0
                px, py, pz = depth_ray[i, 0], depth_ray[i, 1], depth_ray[i, 2]
                along = t20 * px + t21 * py + t22 * pz
                v0 = a0 * (t00 * px + t01 * py + t02 * pz) + a2 * along
                v1 = b1 * (t10 * px + t11 * py + t12 * pz) + b2 * along
                v2 = c2 * along
                spread = 1.0 / (s2 + v0 * v0 + v1 * v1 + v2 * v2)
                rv = r0 * v0 + r1 * v1 + r2 * v2
                weight = 1.0 / s2
                e2 = (r0 * r0 + r1 * r1 + r2 * r2 - rv * rv * spread) * weight
                limit = chi2 * 1.3 if stereo else chi2
                if judge:
                    inlier[i] = e2 <= limit
                    if not inlier[i]:
                        continue
                    count += 1
                    total += e2 / (3.0 if stereo else 2.0)
                    if final:
                        continue
                if e2 > limit * 0.5:
                    weight *= np.sqrt(limit * 0.5 / e2)
                # by (x, y, z): m = weight (J^T J - j j^T spread) with j = J^T v, and q = weight J^T (r - v rv spread)
                j0, j1, j2 = a0 * v0, b1 * v1, a2 * v0 + b2 * v1 + c2 * v2
                spread *= weight
                rv *= spread
                q0 = weight * a0 * r0 - rv * j0
                q1 = weight * b1 * r1 - rv * j1
                q2 = weight * (a2 * r0 + b2 * r1 + c2 * r2) - rv * j2
                m00 = weight * a0 * a0 - spread * j0 * j0
                m01 = -spread * j0 * j1
                m02 = weight * a0 * a2 - spread * j0 * j2
                m11 = weight * b1 * b1 - spread * j1 * j1
                m12 = weight * b1 * b2 - spread * j1 * j2
                m22 = weight * (a2 * a2 + b2 * b2 + c2 * c2) - spread * j2 * j2
                # a rotation w moves the point by w x p: its slopes are those by (x, y, z) times -[p]x
                n00, n01, n02 = m02 * y - m01 * z, m00 * z - m02 * x, m01 * x - m00 * y
                n10, n11, n12 = m12 * y - m11 * z, m01 * z - m12 * x, m11 * x - m01 * y
                n20, n21, n22 = m22 * y - m12 * z, m02 * z - m22 * x, m12 * x - m02 * y
                g[0] -= q0
                g[1] -= q1
                g[2] -= q2
                g[3] -= y * q2 - z * q1
                g[4] -= z * q0 - x * q2
                g[5] -= x * q1 - y * q0
                h[0, 0] += m00
                h[1, 0] += m01
                h[1, 1] += m11
                h[2, 0] += m02
                h[2, 1] += m12
                h[2, 2] += m22
                h[3, 0] += n00
                h[3, 1] += n10
                h[3, 2] += n20
                h[4, 0] += n01
                h[4, 1] += n11
                h[4, 2] += n21
                h[5, 0] += n02
                h[5, 1] += n12
                h[5, 2] += n22
                h[3, 3] += y * n20 - z * n10
                h[4, 3] += z * n00 - x * n20
                h[4, 4] += z * n01 - x * n21
                h[5, 3] += x * n10 - y * n00
                h[5, 4] += x * n11 - y * n01
                h[5, 5] += x * n12 - y * n02
            if final:
                break
            for a in range(6):
                h[a, a] += 1e-6
            if not solve6(h, g, step):
                break
            _exp(step, dr, dt)
            _apply_left(dr, dt, T_c_m)
            norm = 0.0
            for a in range(6):
                norm += step[a] * step[a]
            if norm < _STILL:
                break
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

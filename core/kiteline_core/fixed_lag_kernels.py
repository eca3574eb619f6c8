"""Normal equations of a short chain of inertial states, their elimination, and the marginalisation of the oldest.

A state is a rotation R_m_b and 12 numbers: position, velocity (m), gyro bias, accel bias. Its 15 degrees of freedom are
[rotation (on the right), position, velocity, gyro bias, accel bias]. All states share the direction of gravity, two tilt
angles about x and y of m. The matrix is block tridiagonal with a border of width 2, so elimination goes along the chain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core.imu_kernels import (
    mul33,
    mul33_skew,
    mul33_tn,
    right_jacobian,
    right_jacobian_inverse,
    so3_exp,
    so3_log,
)
from kiteline_core.jit import njit

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]
I64 = NDArray[np.int64]

_D = 15  # degrees of freedom of a state
_B = 17  # of a state and gravity
_W = 32  # of two states and gravity


@njit
def down_of_tilt(tilt: F64, down: F64, jac: F64) -> None:
    """The unit vector of gravity, -Exp([tilt, 0]) z, and its (3,2) Jacobian by the tilt (2,) in rad."""
    x, y = tilt[1], -tilt[0]
    a2 = x * x + y * y
    if a2 < 1e-8:
        s, ds = 1.0 - a2 / 6.0, -1.0 / 3.0
    else:
        a = np.sqrt(a2)
        s = np.sin(a) / a
        ds = (np.cos(a) - s) / a2
    down[0], down[1], down[2] = -s * x, -s * y, -np.cos(np.sqrt(a2))
    xx, xy, yy = s + ds * x * x, ds * x * y, s + ds * y * y
    jac[0, 0], jac[0, 1] = xy, -xx
    jac[1, 0], jac[1, 1] = yy, -xy
    jac[2, 0], jac[2, 1] = -s * y, s * x


@njit
def visual_terms(
    r: F64, p: F64, r_cb: F64, t_cb: F64, camera: F64, n: int, xyz: F64, ray: F64, observed: F64, sigma_px: F64,
    use: Bools, chi2: float, scale: float, h: F64, b: F64,
) -> float:  # fmt: skip
    """Information h (6,6) and right side b (6,) of [rotation, position] of one body pose from its points.

    r (3,3), p (3,): body in m. r_cb, t_cb: body in the camera. camera: fx, fy, cx, cy, bf. xyz, ray, observed, sigma_px:
    as in pose_kernels.optimise_pose. use: (n,). chi2: squared error of 2 measurements from which on Huber's weight falls
    is half of it. scale: of the information, below 1 because errors of templates last over frames. Returns the cost.
    """
    fx, fy, cx, cy, bf = camera[0], camera[1], camera[2], camera[3], camera[4]
    q = np.empty((3, 3))  # R_c_m
    for i in range(3):
        for j in range(3):
            q[i, j] = r_cb[i, 0] * r[j, 0] + r_cb[i, 1] * r[j, 1] + r_cb[i, 2] * r[j, 2]
    hc, bc = np.zeros((6, 6)), np.zeros(6)
    jac, res, v, jv = np.zeros((3, 6)), np.zeros(3), np.zeros(3), np.zeros(6)
    cost = 0.0
    for k in range(n):
        if not use[k]:
            continue
        dx, dy, dz = xyz[k, 0] - p[0], xyz[k, 1] - p[1], xyz[k, 2] - p[2]
        x = q[0, 0] * dx + q[0, 1] * dy + q[0, 2] * dz + t_cb[0]
        y = q[1, 0] * dx + q[1, 1] * dy + q[1, 2] * dz + t_cb[1]
        z = q[2, 0] * dx + q[2, 1] * dy + q[2, 2] * dz + t_cb[2]
        if z < 0.05:
            continue
        iz = 1.0 / z
        res[0] = fx * x * iz + cx - observed[k, 0]
        res[1] = fy * y * iz + cy - observed[k, 1]
        res[2] = bf * iz - observed[k, 2]
        a0, a2 = fx * iz, -fx * x * iz * iz
        b1, b2 = fy * iz, -fy * y * iz * iz
        c2 = -bf * iz * iz
        rows = 3 if observed[k, 2] >= 0.0 else 2
        # by a perturbation [translation, rotation] of the camera: dp = dt + w x p
        jac[0, 0], jac[0, 2] = a0, a2
        jac[0, 3], jac[0, 4], jac[0, 5] = a2 * y, a0 * z - a2 * x, -a0 * y
        jac[1, 1], jac[1, 2] = b1, b2
        jac[1, 3], jac[1, 4], jac[1, 5] = -b1 * z + b2 * y, -b2 * x, b1 * x
        jac[2, 2] = c2
        jac[2, 3], jac[2, 4] = c2 * y, -c2 * x
        rx = q[0, 0] * ray[k, 0] + q[0, 1] * ray[k, 1] + q[0, 2] * ray[k, 2]
        ry = q[1, 0] * ray[k, 0] + q[1, 1] * ray[k, 1] + q[1, 2] * ray[k, 2]
        rz = q[2, 0] * ray[k, 0] + q[2, 1] * ray[k, 1] + q[2, 2] * ray[k, 2]
        v[0], v[1], v[2] = a0 * rx + a2 * rz, b1 * ry + b2 * rz, c2 * rz
        s2 = sigma_px[k] * sigma_px[k]
        vv, rv, rr = s2, 0.0, 0.0
        for i in range(rows):
            vv += v[i] * v[i]
            rv += res[i] * v[i]
            rr += res[i] * res[i]
        e2 = (rr - rv * rv / vv) / s2
        knee = 0.5 * (chi2 if rows == 2 else chi2 * 1.3)
        weight = scale / s2
        if e2 > knee:
            weight *= np.sqrt(knee / e2)
            cost += scale * (2.0 * np.sqrt(knee * e2) - knee)
        else:
            cost += scale * e2
        for a in range(6):
            s, t = 0.0, 0.0
            for i in range(rows):
                s += jac[i, a] * v[i]
                t += jac[i, a] * res[i]
            jv[a] = s
            bc[a] -= weight * (t - s * rv / vv)
        for a in range(6):
            for c in range(a + 1):
                s = 0.0
                for i in range(rows):
                    s += jac[i, a] * jac[i, c]
                hc[a, c] += weight * (s - jv[a] * jv[c] / vv)
    for a in range(6):
        for c in range(a):
            hc[c, a] = hc[a, c]
    # the camera's perturbation by the body's [rotation on the right, position in m]
    m = np.zeros((6, 6))
    for j in range(3):
        c0, c1, c3 = r_cb[0, j], r_cb[1, j], r_cb[2, j]
        m[0, j] = -(t_cb[1] * c3 - t_cb[2] * c1)
        m[1, j] = -(t_cb[2] * c0 - t_cb[0] * c3)
        m[2, j] = -(t_cb[0] * c1 - t_cb[1] * c0)
        for i in range(3):
            m[i, 3 + j] = -q[i, j]
            m[3 + i, j] = -r_cb[i, j]
    hm = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            s = 0.0
            for k in range(6):
                s += hc[i, k] * m[k, j]
            hm[i, j] = s
    for i in range(6):
        s = 0.0
        for k in range(6):
            s += m[k, i] * bc[k]
        b[i] = s
        for j in range(6):
            s = 0.0
            for k in range(6):
                s += m[k, i] * hm[k, j]
            h[i, j] = s
    return cost


@njit
def imu_terms(
    ri: F64, si: F64, rj: F64, sj: F64, tilt: F64, gravity: float, dt: float, turn: F64, vp: F64, jac: F64, bias: F64,
    res: F64, j: F64,
) -> None:  # fmt: skip
    """Residual res (9,) [rotation, velocity, position] of a preintegrated motion and its Jacobian j (9,32) by
    [first state, second state, tilt].
    """
    db, wb, rr = np.empty(6), np.empty(3), np.empty(3)
    a, b, c, d, e = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    down, dg = np.empty(3), np.empty((3, 2))
    u, w = np.empty(3), np.empty(3)
    for i in range(6):
        db[i] = si[6 + i] - bias[i]
    for i in range(3):
        wb[i] = jac[i, 0] * db[0] + jac[i, 1] * db[1] + jac[i, 2] * db[2]
    so3_exp(wb, a)
    mul33(turn, a, b)
    mul33_tn(ri, rj, c)
    mul33_tn(b, c, d)
    so3_log(d, rr)
    down_of_tilt(tilt, down, dg)
    for i in range(3):
        g = gravity * down[i]
        u[i] = sj[3 + i] - si[3 + i] - g * dt
        w[i] = sj[i] - si[i] - si[3 + i] * dt - 0.5 * g * dt * dt
    for i in range(9):
        for k in range(_W):
            j[i, k] = 0.0
    right_jacobian_inverse(rr, a)  # by the second rotation
    right_jacobian(wb, b)
    # by the gyro bias: -Jr^-1(res) Exp(res)^T Jr(wb) jac
    mul33_tn(d, b, e)
    mul33(a, e, b)
    for i in range(3):
        res[i] = rr[i]
        for k in range(3):
            j[i, _D + k] = a[i, k]
            s, t = 0.0, 0.0
            for m in range(3):
                s += a[i, m] * c[k, m]
                t += b[i, m] * jac[m, k]
            j[i, k] = -s
            j[i, 9 + k] = -t
    uv, wv = np.empty(3), np.empty(3)
    for i in range(3):
        uv[i] = ri[0, i] * u[0] + ri[1, i] * u[1] + ri[2, i] * u[2]
        wv[i] = ri[0, i] * w[0] + ri[1, i] * w[1] + ri[2, i] * w[2]
        s, t = vp[i], vp[3 + i]
        for m in range(6):
            s += jac[3 + i, m] * db[m]
            t += jac[6 + i, m] * db[m]
        res[3 + i] = uv[i] - s
        res[6 + i] = wv[i] - t
    for i in range(3):
        for k in range(3):
            rt = ri[k, i]
            j[3 + i, 6 + k] = -rt
            j[3 + i, _D + 6 + k] = rt
            j[6 + i, 3 + k] = -rt
            j[6 + i, 6 + k] = -rt * dt
            j[6 + i, _D + 3 + k] = rt
        for k in range(6):
            j[3 + i, 9 + k] = -jac[3 + i, k]
            j[6 + i, 9 + k] = -jac[6 + i, k]
        for k in range(2):
            s = gravity * (ri[0, i] * dg[0, k] + ri[1, i] * dg[1, k] + ri[2, i] * dg[2, k])
            j[3 + i, 30 + k] = -s * dt
            j[6 + i, 30 + k] = -0.5 * s * dt * dt
    j[3, 1], j[3, 2] = -uv[2], uv[1]
    j[4, 0], j[4, 2] = uv[2], -uv[0]
    j[5, 0], j[5, 1] = -uv[1], uv[0]
    j[6, 1], j[6, 2] = -wv[2], wv[1]
    j[7, 0], j[7, 2] = wv[2], -wv[0]
    j[8, 0], j[8, 1] = -wv[1], wv[0]


@njit
def _add_imu(
    ri: F64, si: F64, rj: F64, sj: F64, tilt: F64, gravity: float, dt: float, turn: F64, vp: F64, jac: F64, bias: F64,
    info: F64, walk: F64, h: F64, b: F64,
) -> float:  # fmt: skip
    """Normal equations h (32,32), b (32,) of one preintegrated motion and the walk of the biases. Returns the cost."""
    res, j = np.empty(9), np.empty((9, _W))
    imu_terms(ri, si, rj, sj, tilt, gravity, dt, turn, vp, jac, bias, res, j)
    wj = np.empty((9, _W))
    cost = 0.0
    for i in range(9):
        s = 0.0
        for k in range(9):
            s += info[i, k] * res[k]
        cost += res[i] * s
        for c in range(_W):
            t = 0.0
            if c < 24 or c >= 30:
                for k in range(9):
                    t += info[i, k] * j[k, c]
            wj[i, c] = t
    for r in range(_W):
        s = 0.0
        for c in range(_W):
            h[r, c] = 0.0
        if r < 24 or r >= 30:
            for k in range(9):
                s += wj[k, r] * res[k]
            for c in range(r + 1):
                t = 0.0
                for k in range(9):
                    t += j[k, r] * wj[k, c]
                h[r, c] = t
        b[r] = -s
    for i in range(6):
        q = walk[0] if i < 3 else walk[1]
        e = sj[6 + i] - si[6 + i]
        cost += q * e * e
        h[9 + i, 9 + i] += q
        h[24 + i, 24 + i] += q
        h[24 + i, 9 + i] -= q
        b[9 + i] += q * e
        b[24 + i] -= q * e
    for r in range(_W):
        for c in range(r):
            h[c, r] = h[r, c]
    return cost


@njit
def _from_linearised(r: F64, p: F64, h: F64, b: F64, at_r: F64, at_p: F64, out: F64) -> None:
    """Right side out (6,) at a pose of a term h (6,6), b (6,) that was linearised at another pose."""
    rel, d = np.empty((3, 3)), np.empty(6)
    mul33_tn(at_r, r, rel)
    so3_log(rel, d[:3])
    for i in range(3):
        d[3 + i] = p[i] - at_p[i]
    for i in range(6):
        s = b[i]
        for k in range(6):
            s -= h[i, k] * d[k]
        out[i] = s


@njit
def _prior_side(
    r: F64, s: F64, tilt: F64, prior_h: F64, prior_b: F64, prior_r: F64, prior_s: F64, prior_tilt: F64, out: F64
) -> None:
    """Right side out (17,) of the prior on [state, tilt] at the present values."""
    rel, d = np.empty((3, 3)), np.empty(_B)
    mul33_tn(prior_r, r, rel)
    so3_log(rel, d[:3])
    for i in range(12):
        d[3 + i] = s[i] - prior_s[i]
    for i in range(2):
        d[_D + i] = tilt[i] - prior_tilt[i]
    for i in range(_B):
        t = prior_b[i]
        for k in range(_B):
            t -= prior_h[i, k] * d[k]
        out[i] = t


@njit
def eliminate(a: F64, keep: int, width: int) -> bool:
    """Cholesky elimination of the first `keep` rows of a symmetric system a (>= width, >= width + 1), in place.

    Column `width` holds the right side. Rows above `keep` become the upper triangle of the factor, the rest the Schur
    complement. False when the part to eliminate is not positive definite.
    """
    for k in range(keep):
        d = a[k, k]
        if not d > 1e-12:
            return False
        inv = 1.0 / np.sqrt(d)
        for c in range(k, width + 1):
            a[k, c] *= inv
        for r in range(k + 1, width):
            f = a[k, r]
            if f != 0.0:
                for c in range(r, width + 1):
                    a[r, c] -= f * a[k, c]
    return True


@njit
def smooth(
    n: int, iterations: int, fresh: int, rot: F64, state: F64, tilt: F64, gravity: float,
    imu_dt: F64, imu_turn: F64, imu_vp: F64, imu_jac: F64, imu_bias: F64, imu_info: F64, imu_walk: F64,
    prior_h: F64, prior_b: F64, prior_r: F64, prior_s: F64, prior_tilt: F64,
    r_cb: F64, t_cb: F64, camera: F64, counts: I64, xyz: F64, ray: F64, observed: F64, sigma_px: F64, use: Bools,
    chi2: float, scale: F64, vis_h: F64, vis_b: F64, vis_r: F64, vis_p: F64, cov: F64,
) -> float:  # fmt: skip
    """Gauss-Newton over the n states of the window, in place.

    fresh: so many of the newest states have their points linearised anew at each iteration; older ones keep the term to
    which their points were condensed (vis_*). imu_*[i] leads from state i to i + 1. cov: (17,17) covariance of the newest
    state and the tilt, out. Returns the cost at the last linearisation, negative when the system could not be solved.
    """
    blocks = np.zeros((n, _W, _W + 1))
    term, side = np.empty((_W, _W)), np.empty(_W)
    out6, out17, x = np.empty(6), np.empty(_B), np.zeros((n, _D))
    xg = np.zeros(2)
    turn, after = np.empty((3, 3)), np.empty((3, 3))
    cost = 0.0
    for it in range(iterations):
        cost = 0.0
        blocks[:] = 0.0
        # gravity's part of the system rides in rows and columns 30, 31 of every block and is passed on
        _prior_side(rot[0], state[0], tilt, prior_h, prior_b, prior_r, prior_s, prior_tilt, out17)
        for i in range(_B):
            ii = i if i < _D else 15 + i
            blocks[0, ii, _W] += out17[i]
            for k in range(_B):
                blocks[0, ii, k if k < _D else 15 + k] += prior_h[i, k]
        for f in range(n):
            if f >= n - fresh:
                cost += visual_terms(
                    rot[f], state[f, :3], r_cb, t_cb, camera, counts[f], xyz[f], ray[f], observed[f], sigma_px[f],
                    use[f], chi2, scale[f], vis_h[f], vis_b[f],
                )  # fmt: skip
                vis_r[f] = rot[f]
                vis_p[f] = state[f, :3]
            _from_linearised(rot[f], state[f, :3], vis_h[f], vis_b[f], vis_r[f], vis_p[f], out6)
            for i in range(6):
                blocks[f, i, _W] += out6[i]
                for k in range(6):
                    blocks[f, i, k] += vis_h[f, i, k]
            if f + 1 < n:
                cost += _add_imu(
                    rot[f], state[f], rot[f + 1], state[f + 1], tilt, gravity, imu_dt[f], imu_turn[f], imu_vp[f],
                    imu_jac[f], imu_bias[f], imu_info[f], imu_walk[f], term, side,
                )  # fmt: skip
                for i in range(_W):
                    blocks[f, i, _W] += side[i]
                    for k in range(_W):
                        blocks[f, i, k] += term[i, k]
                if not eliminate(blocks[f], _D, _W):
                    return -1.0
                for i in range(_D, _W):
                    ii = i - _D if i < 30 else i
                    blocks[f + 1, ii, _W] += blocks[f, i, _W]
                    for k in range(i, _W):
                        kk = k - _D if k < 30 else k
                        blocks[f + 1, ii, kk] += blocks[f, i, k]
                        if kk != ii:
                            blocks[f + 1, kk, ii] += blocks[f, i, k]
        last = np.empty((_B, _B + 1))
        for i in range(_B):
            ii = i if i < _D else 15 + i
            last[i, _B] = blocks[n - 1, ii, _W]
            for k in range(_B):
                last[i, k] = blocks[n - 1, ii, k if k < _D else 15 + k]
        if not eliminate(last, _B, _B):
            return -1.0
        if it == iterations - 1:
            _invert(last, cov)
        for i in range(_B - 1, -1, -1):
            s = last[i, _B]
            for k in range(i + 1, _B):
                s -= last[i, k] * (x[n - 1, k] if k < _D else xg[k - _D])
            s /= last[i, i]
            if i < _D:
                x[n - 1, i] = s
            else:
                xg[i - _D] = s
        for f in range(n - 2, -1, -1):
            for i in range(_D - 1, -1, -1):
                s = blocks[f, i, _W]
                for k in range(i + 1, _D):
                    s -= blocks[f, i, k] * x[f, k]
                for k in range(_D):
                    s -= blocks[f, i, _D + k] * x[f + 1, k]
                s -= blocks[f, i, 30] * xg[0] + blocks[f, i, 31] * xg[1]
                x[f, i] = s / blocks[f, i, i]
        biggest = 0.0
        for f in range(n):
            so3_exp(x[f, :3], turn)
            mul33(rot[f], turn, after)
            rot[f] = after
            for i in range(12):
                state[f, i] += x[f, 3 + i]
            for i in range(6):
                biggest = max(biggest, abs(x[f, i]))
        tilt[0] += xg[0]
        tilt[1] += xg[1]
        if not biggest < 10.0:
            return -1.0
    return cost


@njit
def _invert(u: F64, cov: F64) -> None:
    """cov (17,17) = (U^T U)^-1 of the upper triangle U in the first columns of u."""
    inv = np.zeros((_B, _B))
    for c in range(_B):
        for i in range(c, -1, -1):
            s = 1.0 if i == c else 0.0
            for k in range(i + 1, c + 1):
                s -= u[i, k] * inv[k, c]
            inv[i, c] = s / u[i, i]
    for i in range(_B):
        for j in range(i + 1):
            s = 0.0
            for k in range(max(i, j), _B):
                s += inv[i, k] * inv[j, k]
            cov[i, j] = s
            cov[j, i] = s


@njit
def marginalise(
    rot: F64, state: F64, tilt: F64, gravity: float, dt: float, turn: F64, vp: F64, jac: F64, bias: F64, info: F64,
    walk: F64, vis_h: F64, vis_b: F64, vis_r: F64, vis_p: F64, tilt_walk: float, prior_h: F64, prior_b: F64,
    prior_r: F64, prior_s: F64, prior_tilt: F64,
) -> bool:  # fmt: skip
    """Turn the prior on state 0 (of the first two, rot (2,3,3), state (2,12)) into the prior on state 1, in place.

    tilt_walk: variance in rad^2 by which gravity's direction in the map may have moved meanwhile.
    """
    a = np.zeros((_W, _W + 1))
    term, side, out6, out17 = np.empty((_W, _W)), np.empty(_W), np.empty(6), np.empty(_B)
    _add_imu(
        rot[0], state[0], rot[1], state[1], tilt, gravity, dt, turn, vp, jac, bias, info, walk, term, side
    )  # fmt: skip
    for i in range(_W):
        a[i, _W] = side[i]
        for k in range(_W):
            a[i, k] = term[i, k]
    _prior_side(rot[0], state[0], tilt, prior_h, prior_b, prior_r, prior_s, prior_tilt, out17)
    for i in range(_B):
        ii = i if i < _D else 15 + i
        a[ii, _W] += out17[i]
        for k in range(_B):
            a[ii, k if k < _D else 15 + k] += prior_h[i, k]
    _from_linearised(rot[0], state[0, :3], vis_h, vis_b, vis_r, vis_p, out6)
    for i in range(6):
        a[i, _W] += out6[i]
        for k in range(6):
            a[i, k] += vis_h[i, k]
    if not eliminate(a, _D, _W):
        return False
    for i in range(_B):
        prior_b[i] = a[_D + i, _W]
        for k in range(i, _B):
            prior_h[i, k] = a[_D + i, _D + k]
            prior_h[k, i] = prior_h[i, k]
    # gravity walks: eliminate its old value from the prior joined with (new - old)^2 / tilt_walk
    if tilt_walk > 0.0:
        _let_tilt_walk(1.0 / tilt_walk, prior_h, prior_b)
    prior_r[:] = rot[1]
    prior_s[:] = state[1]
    prior_tilt[:] = tilt
    return True


@njit
def _let_tilt_walk(q: float, h: F64, b: F64) -> None:
    s00, s01, s11 = h[15, 15] + q, h[15, 16], h[16, 16] + q
    det = s00 * s11 - s01 * s01
    i00, i01, i11 = s11 / det, -s01 / det, s00 / det
    g = np.empty((15, 2))
    for i in range(15):
        g[i, 0], g[i, 1] = h[i, 15], h[i, 16]
    for i in range(15):
        k0, k1 = g[i, 0] * i00 + g[i, 1] * i01, g[i, 0] * i01 + g[i, 1] * i11
        b[i] -= k0 * b[15] + k1 * b[16]
        for k in range(15):
            h[i, k] -= k0 * g[k, 0] + k1 * g[k, 1]
        h[i, 15], h[15, i] = q * k0, q * k0
        h[i, 16], h[16, i] = q * k1, q * k1
    b0, b1 = b[15], b[16]
    b[15], b[16] = q * (i00 * b0 + i01 * b1), q * (i01 * b0 + i11 * b1)
    h[15, 15], h[16, 16] = q - q * q * i00, q - q * q * i11
    h[15, 16], h[16, 15] = -q * q * i01, -q * q * i01

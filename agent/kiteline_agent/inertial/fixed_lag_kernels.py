"""Kernels of a short chain of inertial states: normal equations, elimination, marginalisation of the oldest state.

States and residuals are those of inertial_kernels. The matrix is block tridiagonal with a border of width 2 (gravity),
so elimination goes along the chain.
"""

import numpy as np

from kiteline_agent.inertial.imu_kernels import copy33, mul33, mul33_tn, so3_exp, so3_log
from kiteline_agent.inertial.inertial_kernels import imu_terms, velocity_terms, visual_terms
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.jit import helper, njit

_D = 15  # degrees of freedom of a state
_B = 17  # of a state and gravity
_W = 32  # of two states and gravity


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
    """Right-hand side out (6,) at a pose, of a term h (6,6), b (6,) linearised at another pose."""
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
    """Right-hand side out (17,) of the prior on [state, tilt] at the current values."""
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


@helper
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
    r_cb: F64, t_cb: F64, camera: F64, counts: I64, xyz: F64, ray: F64, observed: F64, sigma_px: F64, use: Bool,
    chi2: float, scale: F64, vis_h: F64, vis_b: F64, vis_r: F64, vis_p: F64, vel: F64, vel_info: F64, cov: F64,
) -> float:  # fmt: skip
    """Gauss-Newton over the n states of the window, in place.

    fresh: so many of the newest states have their points linearised anew at each iteration; older ones keep the term to
    which their points were condensed (vis_*). vel (n,3), vel_info (n,3,3): velocities in the body's axes that an
    odometer measured, and what they are worth (0: nothing). imu_*[i] leads from state i to i + 1. cov: (17,17)
    covariance of the newest state and the tilt, out. Returns the cost at the last linearisation, negative when the
    system could not be solved.
    """
    blocks = np.zeros((n, _W, _W + 1))
    term, side = np.empty((_W, _W)), np.empty(_W)
    out6, out17, x = np.empty(6), np.empty(_B), np.zeros((n, _D))
    xg = np.zeros(2)
    turn, after = np.empty((3, 3)), np.empty((3, 3))
    cost = 0.0
    for it in range(iterations):
        cost = 0.0
        for f in range(n):
            for i in range(_W):
                for k in range(_W + 1):
                    blocks[f, i, k] = 0.0
        # gravity's part of the system is in rows and columns 30, 31 of every block and is passed to the next
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
                copy33(rot[f], vis_r[f])
                for i in range(3):
                    vis_p[f, i] = state[f, i]
            _from_linearised(rot[f], state[f, :3], vis_h[f], vis_b[f], vis_r[f], vis_p[f], out6)
            for i in range(6):
                blocks[f, i, _W] += out6[i]
                for k in range(6):
                    blocks[f, i, k] += vis_h[f, i, k]
            if vel_info[f, 0, 0] > 0.0:
                cost += velocity_terms(
                    rot[f], state[f, 3:6], vel[f], vel_info[f], blocks[f], blocks[f, :, _W], 0
                )  # fmt: skip
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
            copy33(after, rot[f])
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
    walk: F64, vis_h: F64, vis_b: F64, vis_r: F64, vis_p: F64, vel: F64, vel_info: F64, tilt_walk: float,
    prior_h: F64, prior_b: F64, prior_r: F64, prior_s: F64, prior_tilt: F64,
) -> bool:  # fmt: skip
    """Transform the prior on state 0 (of the first two, rot (2,3,3), state (2,12)) into the prior on state 1, in place.

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
    if vel_info[0, 0] > 0.0:
        velocity_terms(rot[0], state[0, 3:6], vel, vel_info, a, a[:, _W], 0)
    if not eliminate(a, _D, _W):
        return False
    for i in range(_B):
        prior_b[i] = a[_D + i, _W]
        for k in range(i, _B):
            prior_h[i, k] = a[_D + i, _D + k]
            prior_h[k, i] = prior_h[i, k]
    if tilt_walk > 0.0:  # eliminate the old tilt from the prior plus (new - old)^2 / tilt_walk
        _add_tilt_walk(1.0 / tilt_walk, prior_h, prior_b)
    copy33(rot[1], prior_r)
    for i in range(12):
        prior_s[i] = state[1, i]
    for i in range(2):
        prior_tilt[i] = tilt[i]
    return True


@njit
def _add_tilt_walk(q: float, h: F64, b: F64) -> None:
    """The prior h (17,17), b (17,) on [state, tilt] after a random walk of the tilt, of information q in 1/rad^2."""
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

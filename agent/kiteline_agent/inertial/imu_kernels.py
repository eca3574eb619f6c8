"""Kernels of 3x3 rotations and of the preintegration of IMU samples between two instants.

Source: C. Forster, L. Carlone, F. Dellaert, D. Scaramuzza, "On-manifold preintegration for real-time visual-inertial
odometry", 2017; rotations are perturbed on the right, R = R_hat Exp(phi). Midpoint rule instead of Euler's.
"""

import numpy as np

from kiteline_core.arrays import F64, I64
from kiteline_core.jit import helper, njit


@helper
def copy33(a: F64, out: F64) -> None:
    """out = a for (3,3) matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, j]


@helper
def mul33(a: F64, b: F64, out: F64) -> None:
    """out = a @ b for (3,3) matrices; out may be neither a nor b."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@helper
def mul33_tn(a: F64, b: F64, out: F64) -> None:
    """out = a.T @ b for (3,3) matrices; out may be neither a nor b."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]


@helper
def mul33_skew(a: F64, v: F64, out: F64) -> None:
    """out = a @ skew(v)."""
    for i in range(3):
        out[i, 0] = a[i, 1] * v[2] - a[i, 2] * v[1]
        out[i, 1] = a[i, 2] * v[0] - a[i, 0] * v[2]
        out[i, 2] = a[i, 0] * v[1] - a[i, 1] * v[0]


@njit
def _series(w: F64, c0: float, c1: float, c2: float, out: F64) -> None:
    """out = c0 I + c1 skew(w) + c2 skew(w)^2, where skew(w)^2 = w w^T - |w|^2 I."""
    n2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    for i in range(3):
        for j in range(3):
            out[i, j] = c2 * w[i] * w[j]
        out[i, i] += c0 - c2 * n2
    out[0, 1] -= c1 * w[2]
    out[0, 2] += c1 * w[1]
    out[1, 0] += c1 * w[2]
    out[1, 2] -= c1 * w[0]
    out[2, 0] -= c1 * w[1]
    out[2, 1] += c1 * w[0]


@njit
def so3_exp(w: F64, out: F64) -> None:
    """Rotation (3,3) of a rotation vector (3,)."""
    n2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if n2 < 1e-8:
        _series(w, 1.0, 1.0 - n2 / 6.0, 0.5 - n2 / 24.0, out)
    else:
        n = np.sqrt(n2)
        _series(w, 1.0, np.sin(n) / n, (1.0 - np.cos(n)) / n2, out)


@helper
def right_jacobian(w: F64, out: F64) -> None:
    """Exp(w + d) = Exp(w) Exp(out @ d) to first order."""
    n2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if n2 < 1e-6:
        _series(w, 1.0, -0.5 + n2 / 24.0, 1.0 / 6.0 - n2 / 120.0, out)
    else:
        n = np.sqrt(n2)
        _series(w, 1.0, -(1.0 - np.cos(n)) / n2, (n - np.sin(n)) / (n2 * n), out)


@helper
def right_jacobian_inverse(w: F64, out: F64) -> None:
    """The inverse of right_jacobian(w), for angles below pi."""
    n2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if n2 < 1e-6:
        _series(w, 1.0, 0.5, 1.0 / 12.0 + n2 / 720.0, out)
    else:
        n = np.sqrt(n2)
        _series(w, 1.0, 0.5, 1.0 / n2 - (1.0 + np.cos(n)) / (2.0 * n * np.sin(n)), out)


@helper
def so3_log(r: F64, out: F64) -> None:
    """Rotation vector (3,) of a rotation (3,3), for angles below pi."""
    out[0] = 0.5 * (r[2, 1] - r[1, 2])
    out[1] = 0.5 * (r[0, 2] - r[2, 0])
    out[2] = 0.5 * (r[1, 0] - r[0, 1])
    s = np.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    c = 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0)
    if s > 1e-9:
        k = np.arctan2(s, c) / s
        for i in range(3):
            out[i] *= k


@njit
def preintegrate(
    t_s: F64, gyro: F64, accel: F64, bias: F64, density: F64, turn: F64, vp: F64, cov: F64, jac: F64
) -> None:
    """Motion between the first and the last sample, in the body frame of the first and without gravity.

    t_s: (n,) s, increasing. gyro, accel: (n,3). bias: (6,) gyro, accel, taken off. density: (n-1,2) noise of gyro and
    accel per square root of Hz in each step. Out: turn (3,3); vp (6,) change of velocity, change of position; cov (9,9)
    of [rotation, velocity, position]; jac (9,6) of the same by the biases.
    """
    n = t_s.shape[0]
    w, a0, a1, aa = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    exp, jr, after, ra, rb = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    rc, rd = np.zeros((3, 3)), np.zeros((3, 3))
    f, b = np.zeros((9, 9)), np.zeros((9, 6))
    tmp, tmp6 = np.zeros((9, 9)), np.zeros((9, 6))
    for i in range(9):
        for j in range(9):
            cov[i, j] = 0.0
        for j in range(6):
            jac[i, j] = 0.0
    for i in range(3):
        vp[i] = 0.0
        vp[3 + i] = 0.0
        for j in range(3):
            turn[i, j] = 1.0 if i == j else 0.0
    for k in range(n - 1):
        dt = t_s[k + 1] - t_s[k]
        for i in range(3):
            w[i] = (0.5 * (gyro[k, i] + gyro[k + 1, i]) - bias[i]) * dt
            a0[i] = accel[k, i] - bias[3 + i]
            a1[i] = accel[k + 1, i] - bias[3 + i]
        so3_exp(w, exp)
        right_jacobian(w, jr)
        mul33(turn, exp, after)
        # error of the mean acceleration by the rotation error before and after the step
        mul33_skew(turn, a0, ra)
        mul33_skew(after, a1, rb)
        for i in range(3):
            for j in range(3):
                rc[i, j] = rb[i, 0] * exp[j, 0] + rb[i, 1] * exp[j, 1] + rb[i, 2] * exp[j, 2]
        mul33(rb, jr, rd)
        for i in range(9):
            for j in range(9):
                f[i, j] = 1.0 if i == j else 0.0
            for j in range(6):
                b[i, j] = 0.0
        for i in range(3):
            f[3 + i, 3 + i] = 1.0
            f[6 + i, 3 + i] = dt
            for j in range(3):
                f[i, j] = exp[j, i]
                by_turn = -0.5 * (ra[i, j] + rc[i, j])
                f[3 + i, j] = by_turn * dt
                f[6 + i, j] = 0.5 * by_turn * dt * dt
                b[i, j] = -jr[i, j] * dt
                by_gyro = 0.5 * rd[i, j] * dt
                b[3 + i, j] = by_gyro * dt
                b[6 + i, j] = 0.5 * by_gyro * dt * dt
                by_accel = -0.5 * (turn[i, j] + after[i, j])
                b[3 + i, 3 + j] = by_accel * dt
                b[6 + i, 3 + j] = 0.5 * by_accel * dt * dt
        for i in range(9):
            for j in range(6):
                s = b[i, j]
                for m in range(9):
                    s += f[i, m] * jac[m, j]
                tmp6[i, j] = s
            for j in range(9):
                s = 0.0
                for m in range(9):
                    s += f[i, m] * cov[m, j]
                tmp[i, j] = s
        qg, qa = density[k, 0] * density[k, 0] / dt, density[k, 1] * density[k, 1] / dt
        for i in range(9):
            for j in range(6):
                jac[i, j] = tmp6[i, j]
            for j in range(i + 1):
                s = 0.0
                for m in range(9):
                    s += tmp[i, m] * f[j, m]
                for m in range(3):
                    s += qg * b[i, m] * b[j, m] + qa * b[i, 3 + m] * b[j, 3 + m]
                cov[i, j] = s
                cov[j, i] = s
        for i in range(3):
            aa[i] = 0.5 * (
                turn[i, 0] * a0[0] + turn[i, 1] * a0[1] + turn[i, 2] * a0[2]
                + after[i, 0] * a1[0] + after[i, 1] * a1[1] + after[i, 2] * a1[2]
            )  # fmt: skip
        for i in range(3):
            vp[3 + i] += vp[i] * dt + 0.5 * aa[i] * dt * dt
            vp[i] += aa[i] * dt
            for j in range(3):
                turn[i, j] = after[i, j]


@njit
def second_differences(t_ns: I64, values: F64, usual_ns: float, even: float, gap: float, sums: F64) -> tuple[int, int]:
    """Sums (2,2) of the squared second differences of samples (n,6), by samples and by means of two neighbours.

    Columns: gyro, accelerometer; each is a mean over three axes, and over the variance of white noise. Samples count
    where the longer of both steps is at most `even` times the shorter one and `gap` times the usual one; pairs where
    all steps are such. Returns the numbers of differences.
    """
    n = t_ns.shape[0]
    for i in range(2):
        sums[i, 0] = sums[i, 1] = 0.0
    count, pairs, run = 0, 0, 0
    for k in range(1, n - 1):
        a, b = float(t_ns[k] - t_ns[k - 1]), float(t_ns[k + 1] - t_ns[k])
        if max(a, b) > even * min(a, b) or max(a, b) > gap * usual_ns:
            run = 0
            continue
        count += 1
        run += 1
        for c in range(6):
            d = values[k + 1, c] - 2.0 * values[k, c] + values[k - 1, c]
            sums[0, c // 3] += d * d / 18.0
        if run >= 4:  # six samples in even steps
            pairs += 1
            for c in range(6):
                d = values[k + 1, c] + values[k, c] + values[k - 3, c] + values[k - 4, c]
                d = 0.5 * d - values[k - 1, c] - values[k - 2, c]
                sums[1, c // 3] += d * d / 9.0
    return count, pairs

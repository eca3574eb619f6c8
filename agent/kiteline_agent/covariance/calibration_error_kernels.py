"""Kernels that propagate calibration errors, shared by a whole flight, to a pose measured against a map."""

import numpy as np

from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry import se3
from kiteline_core.jit import helper, njit

CALIBRATION = 10  # error terms of a calibration, see bias_error: those of the disparity, then those of both cameras
DISPARITY_SHAPES = 5
SHAPES = CALIBRATION + 1  # with the mean offset by the IMU as the last one


@helper
def bias_error(u: float, v: float, disparity: float, camera: F64, half_px: float, out: F64) -> None:
    """out (3,11): error of u, v and disparity for one pixel of each error term at the image's edge.

    Disparity (difference of the cameras): the terms of `disparity_offset`. Both cameras: focal length along x and y,
    principal point along x and y, distortion.
    """
    x, y = (u - camera[2]) / half_px, (v - camera[3]) / half_px
    r2 = x * x + y * y
    for a in range(3):
        for k in range(SHAPES):
            out[a, k] = 0.0
    out[2, 0], out[2, 1], out[2, 2], out[2, 3], out[2, 4] = 1.0, x, y, x * x, x * y
    out[0, 5], out[2, 5] = x, disparity / half_px
    out[1, 6] = y
    out[0, 7], out[1, 8] = 1.0, 1.0
    out[0, 9], out[1, 9] = x * r2, y * r2


@njit
def sensitivity(
    T_c_m: F64, camera: F64, half_px: float, rows: I64, inlier: Bool, xyz: F64, ray: F64, observed: F64, sigma_px: F64,
    per_keyframe: int, T_m_k: F64, anchor_px: F64, rho: F64, of_keyframes: F64, h: F64, g: F64, of_errors: F64,
    side: F64,
) -> None:  # fmt: skip
    """Normal equations of a pose (left perturbation of T_c_m, [translation, rotation]) by the calibration errors.

    T_c_m: (4,4). camera: fx, fy, cx, cy, bf. half_px: half the image's width. rows: (n,) slot * per_keyframe + index.
    inlier: (n,). xyz, ray, observed, sigma_px: as in pose_kernels.optimise_pose. T_m_k: (K,4,4) of slots. anchor_px:
    (K*per_keyframe,2) px. rho: (K*per_keyframe,) 1/m. of_keyframes: (K,6,11) effect on the
    keyframes, as a left perturbation of T_m_k. Out: h (6,6) information, g (6,11): the pose moves by -h^-1 g for a
    pixel of each error. of_errors (10,10): information of the calibration errors, side (16,): right-hand side of pose
    and errors, both by the residuals at T_c_m.
    """
    fx, fy, bf = camera[0], camera[1], camera[4]
    here, there = np.empty((3, SHAPES)), np.empty((3, SHAPES))
    jac, pj, e = np.zeros((3, 6)), np.zeros((3, 3)), np.empty((3, SHAPES))
    v, dk, dm, jv, ev, res = np.empty(3), np.empty(3), np.empty(3), np.empty(6), np.empty(SHAPES), np.empty(3)
    for a in range(CALIBRATION):
        side[6 + a] = 0.0
        for b in range(CALIBRATION):
            of_errors[a, b] = 0.0
    for a in range(6):
        side[a] = 0.0
        for b in range(6):
            h[a, b] = 0.0
        for b in range(SHAPES):
            g[a, b] = 0.0
    for i in range(rows.shape[0]):
        if not inlier[i]:
            continue
        px, py, pz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        x = T_c_m[0, 0] * px + T_c_m[0, 1] * py + T_c_m[0, 2] * pz + T_c_m[0, 3]
        y = T_c_m[1, 0] * px + T_c_m[1, 1] * py + T_c_m[1, 2] * pz + T_c_m[1, 3]
        z = T_c_m[2, 0] * px + T_c_m[2, 1] * py + T_c_m[2, 2] * pz + T_c_m[2, 3]
        if z < 0.05:
            continue
        measured = 3 if observed[i, 2] >= 0.0 else 2
        iz = 1.0 / z
        res[0] = fx * x * iz + camera[2] - observed[i, 0]
        res[1] = fy * y * iz + camera[3] - observed[i, 1]
        res[2] = bf * iz - observed[i, 2]
        pj[0, 0], pj[0, 2] = fx * iz, -fx * x * iz * iz
        pj[1, 1], pj[1, 2] = fy * iz, -fy * y * iz * iz
        pj[2, 2] = -bf * iz * iz
        for k in range(3):
            a, b, c = pj[k, 0], pj[k, 1], pj[k, 2]
            jac[k, 0], jac[k, 1], jac[k, 2] = a, b, c
            jac[k, 3], jac[k, 4], jac[k, 5] = c * y - b * z, a * z - c * x, b * x - a * y
        # error of the point in the map, and the resulting error of the residual with that of the image
        row = rows[i]
        slot = row // per_keyframe
        depth = 1.0 / rho[row]
        u0, v0 = anchor_px[row, 0], anchor_px[row, 1]
        bias_error(u0, v0, bf * rho[row], camera, half_px, there)
        bias_error(observed[i, 0], observed[i, 1], observed[i, 2], camera, half_px, here)
        bx, by = (u0 - camera[2]) / fx, (v0 - camera[3]) / fy
        for s in range(SHAPES):
            farther = -depth * depth * there[2, s] / bf
            dk[0] = there[0, s] / fx * depth + bx * farther
            dk[1] = there[1, s] / fy * depth + by * farther
            dk[2] = farther
            o = of_keyframes[slot]
            for k in range(3):
                dm[k] = T_m_k[slot, k, 0] * dk[0] + T_m_k[slot, k, 1] * dk[1] + T_m_k[slot, k, 2] * dk[2] + o[k, s]
            dm[0] += o[4, s] * pz - o[5, s] * py
            dm[1] += o[5, s] * px - o[3, s] * pz
            dm[2] += o[3, s] * py - o[4, s] * px
            for k in range(3):
                dk[k] = T_c_m[k, 0] * dm[0] + T_c_m[k, 1] * dm[1] + T_c_m[k, 2] * dm[2]
            for k in range(measured):
                e[k, s] = pj[k, 0] * dk[0] + pj[k, 1] * dk[1] + pj[k, 2] * dk[2] - here[k, s]
        # the point's depth is marginalised, as in the pose optimisation
        s2 = sigma_px[i] * sigma_px[i]
        vv = s2
        for k in range(3):
            dm[k] = T_c_m[k, 0] * ray[i, 0] + T_c_m[k, 1] * ray[i, 1] + T_c_m[k, 2] * ray[i, 2]
        for k in range(measured):
            v[k] = pj[k, 0] * dm[0] + pj[k, 1] * dm[1] + pj[k, 2] * dm[2]
            vv += v[k] * v[k]
        rv = 0.0
        for k in range(measured):
            rv += res[k] * v[k]
        for s in range(SHAPES):
            t = 0.0
            for k in range(measured):
                t += e[k, s] * v[k]
            ev[s] = t
        for a in range(CALIBRATION):
            t = 0.0
            for k in range(measured):
                t += e[k, a] * res[k]
            side[6 + a] += (t - ev[a] * rv / vv) / s2
            for b in range(a + 1):
                t = 0.0
                for k in range(measured):
                    t += e[k, a] * e[k, b]
                of_errors[a, b] += (t - ev[a] * ev[b] / vv) / s2
        for a in range(6):
            t = 0.0
            for k in range(measured):
                t += jac[k, a] * v[k]
            jv[a] = t
            t = 0.0
            for k in range(measured):
                t += jac[k, a] * res[k]
            side[a] += (t - jv[a] * rv / vv) / s2
        for a in range(6):
            for b in range(6):
                t = 0.0
                for k in range(measured):
                    t += jac[k, a] * jac[k, b]
                h[a, b] += (t - jv[a] * jv[b] / vv) / s2
            for s in range(SHAPES):
                t = 0.0
                for k in range(measured):
                    t += jac[k, a] * e[k, s]
                g[a, s] += (t - jv[a] * ev[s] / vv) / s2
    for a in range(CALIBRATION):
        for b in range(a):
            of_errors[b, a] = of_errors[a, b]


@njit
def _sandwich(a: F64, m: F64, out: F64) -> None:
    """out (6,6) = a m a^T."""
    t = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            s = 0.0
            for k in range(6):
                s += a[i, k] * m[k, j]
            t[i, j] = s
    for i in range(6):
        for j in range(6):
            s = 0.0
            for k in range(6):
                s += t[i, k] * a[j, k]
            out[i, j] = s


@njit
def _cross_into(t: F64, r: F64, sign: float, a: F64) -> None:
    """a[:3, 3:] = sign * skew(t) @ r."""
    for j in range(3):
        x, y, z = r[0, j], r[1, j], r[2, j]
        a[0, 3 + j] = sign * (t[1] * z - t[2] * y)
        a[1, 3 + j] = sign * (t[2] * x - t[0] * z)
        a[2, 3 + j] = sign * (t[0] * y - t[1] * x)


@njit
def adjoint_into(T: F64, a: F64) -> None:
    """a (6,6): Exp(a x) T = T Exp(x) for x [translation, rotation]."""
    for i in range(3):
        for j in range(3):
            a[i, j] = a[3 + i, 3 + j] = T[i, j]
            a[3 + i, j] = 0.0
    _cross_into(T[:3, 3], T, 1.0, a)


@helper
def body_into(T: F64, j: F64) -> None:
    """j (6,6): of [translation in a, rotation about the body's axes] by a perturbation on the left of T = T_a_b."""
    for i in range(6):
        for k in range(6):
            j[i, k] = 0.0
    t = T[:3, 3]
    for i in range(3):
        j[i, i] = 1.0
        for k in range(3):
            j[3 + i, 3 + k] = T[k, i]
    j[0, 4], j[0, 5] = t[2], -t[1]
    j[1, 3], j[1, 5] = -t[2], t[0]
    j[2, 3], j[2, 4] = t[1], -t[0]


@njit
def pose_covariance(
    noise: F64, shift: F64, calibration: F64, carried: F64, reckoned: F64, extrinsic: F64, T_a_m: F64, T_m_b: F64,
    T_a_b0: F64, left: F64, out: F64,
) -> None:  # fmt: skip
    """Covariance of a body pose in a frame a (o or m itself), the sum of all parts of pose_covariance.py.

    noise (6,6), shift (6,11): of the camera in m, on the left. calibration: (11,11). carried: (6,6) of m in a.
    reckoned: (6,6) [translation in m, rotation about the body's axes]. extrinsic: (6,6), camera in the body. T_a_b0:
    first pose in a. Out: left (6,6) the first three parts on the left of T_a_b; out (6,6) all of it, [translation
    in a, rotation about the body's axes].
    """
    a, j, m, e = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    shapes = shift.shape[1]
    weighted = np.empty((6, shapes))
    for i in range(6):
        for p in range(shapes):
            s = 0.0
            for q in range(shapes):
                s += shift[i, q] * calibration[q, p]
            weighted[i, p] = s
        for k in range(6):
            s = noise[i, k]
            for p in range(shapes):
                s += weighted[i, p] * shift[k, p]
            m[i, k] = s
    adjoint_into(T_a_m, a)
    _sandwich(a, m, left)
    for i in range(6):
        for k in range(6):
            left[i, k] += carried[i, k]
    T = np.eye(4)
    for i in range(3):
        for k in range(4):
            s = T_a_m[i, 3] if k == 3 else 0.0
            for p in range(3):
                s += T_a_m[i, p] * T_m_b[p, k]
            T[i, k] = s
    body_into(T, j)
    _sandwich(j, left, out)
    # dead reckoning: translations rotate from m to a
    turn = np.eye(6)
    for i in range(3):
        for k in range(3):
            turn[i, k] = T_a_m[i, k]
    _sandwich(turn, reckoned, m)
    # extrinsic: on the left of T_a_b it is Ad(T_a_b0) - Ad(T_a_b)
    adjoint_into(T_a_b0, a)
    adjoint_into(T, e)
    for i in range(6):
        for k in range(6):
            out[i, k] += m[i, k]
            a[i, k] -= e[i, k]
    _sandwich(a, extrinsic, m)
    _sandwich(j, m, e)
    for i in range(6):
        for k in range(6):
            out[i, k] += e[i, k]


def from_body(T: F64) -> F64:
    """(6,6): perturbation on the left of T = T_a_b by one of [translation in a, rotation about the body's axes]."""
    out = np.eye(6)
    out[:3, 3:], out[3:, 3:] = se3.skew(T[:3, 3]) @ T[:3, :3], T[:3, :3]
    return out


def adjoint(T: F64) -> F64:
    """(6,6): Exp(adjoint @ x) T = T Exp(x) for x [translation, rotation]."""
    out = np.empty((6, 6))
    adjoint_into(np.ascontiguousarray(T), out)
    return out

"""Kernels of image and IMU residuals with their Jacobians, for inertial states.

A state is a rotation R_m_b and 12 numbers: position, velocity (m), gyro bias, accel bias. Its 15 degrees of freedom
are [rotation (on the right), position, velocity, gyro bias, accel bias]. All states share the direction of gravity,
two tilt angles about x and y of m.
"""

import numpy as np

from kiteline_agent.inertial.imu_kernels import (
    mul33,
    mul33_tn,
    right_jacobian,
    right_jacobian_inverse,
    so3_exp,
    so3_log,
)
from kiteline_core.arrays import F64, Bool
from kiteline_core.jit import helper, njit

_D = 15  # degrees of freedom of a state
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


@helper
def visual_terms(
    r: F64, p: F64, r_cb: F64, t_cb: F64, camera: F64, n: int, xyz: F64, ray: F64, observed: F64, sigma_px: F64,
    use: Bool, chi2: float, scale: float, h: F64, b: F64,
) -> float:  # fmt: skip
    """Information h (6,6) and right-hand side b (6,) of [rotation, position] of a body pose from its points.

    r (3,3), p (3,): body in m. r_cb, t_cb: body in the camera. camera: fx, fy, cx, cy, bf. xyz, ray, observed,
    sigma_px: as in pose_kernels.optimise_pose. use: (n,). chi2: twice the squared error of 2 measurements from which
    on Huber's weight falls; 3 measurements use chi2 * 1.3. scale: of the information, below 1 because errors of
    templates last over frames. Returns the cost.
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


@helper
def velocity_terms(r: F64, v: F64, measured: F64, info: F64, h: F64, b: F64, first: int) -> float:
    """Add a velocity measured in the body's axes to the system h (w,w), b (w,) of a state whose 15 degrees of freedom
    begin at row `first`. r (3,3): R_m_b. v: (3,) m/s in m. measured: (3,) m/s in b. info: (3,3). Returns the cost.
    """
    u, res, j = np.empty(3), np.empty(3), np.zeros((3, 6))  # by the rotation, by the velocity
    for i in range(3):
        u[i] = r[0, i] * v[0] + r[1, i] * v[1] + r[2, i] * v[2]
        res[i] = u[i] - measured[i]
        for k in range(3):
            j[i, 3 + k] = r[k, i]
    j[0, 1], j[0, 2] = -u[2], u[1]
    j[1, 0], j[1, 2] = u[2], -u[0]
    j[2, 0], j[2, 1] = -u[1], u[0]
    cost = 0.0
    for i in range(3):
        s = info[i, 0] * res[0] + info[i, 1] * res[1] + info[i, 2] * res[2]
        cost += res[i] * s
        for a in range(6):
            b[first + (a if a < 3 else 3 + a)] -= j[i, a] * s
    for a in range(6):
        row = first + (a if a < 3 else 3 + a)
        for c in range(6):
            s = 0.0
            for i in range(3):
                for k in range(3):
                    s += j[i, a] * info[i, k] * j[k, c]
            h[row, first + (c if c < 3 else 3 + c)] += s
    return cost


@helper
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

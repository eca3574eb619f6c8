"""Start in motion: gyro bias, velocity, gravity and, without stereo, the scale of a map from poses and IMU.

Source: T. Qin, P. Li, S. Shen, "VINS-Mono", 2018, section V-B, with the positions of a whole window in one linear system and
the known length of gravity imposed by a Lagrange-like refinement on its tangent plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_core import se3
from kiteline_core.imu_preintegration import Preintegrated

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Alignment:
    """velocities: (n,3) m/s in m of every pose. gravity: (3,) m/s^2 in m. scale: metres per unit of the map.
    scale_sigma: one deviation of it, 0 when it was not asked for. residual_m_s: rms of what the velocities disagree.
    gravity_error: relative difference of the length of gravity, before it was imposed, from the true one.
    """

    velocities: F64
    gravity: F64
    scale: float
    scale_sigma: float
    residual_m_s: float
    gravity_error: float


def gyro_bias(T_m_b: F64, motions: list[Preintegrated]) -> F64:
    """Bias (3,) rad/s that makes the gyro agree with turns of the poses T_m_b (n,4,4) between which motions (n-1) lead."""
    bias = motions[0].bias[:3].copy()
    for _ in range(2):
        h, g = np.zeros((3, 3)), np.zeros(3)
        for k, motion in enumerate(motions):
            turn, _ = motion.corrected(np.concatenate([bias, motion.bias[3:]]))
            error = se3.so3_log(turn.T @ T_m_b[k, :3, :3].T @ T_m_b[k + 1, :3, :3])
            j = motion.jac[:3, :3]
            h += j.T @ j
            g += j.T @ error
        bias = bias + np.linalg.solve(h, g)
    return bias


def align(
    T_m_b: F64, p_b_c: F64, motions: list[Preintegrated], bias: F64, gravity_m_s2: float, *, with_scale: bool
) -> Alignment | None:
    """Velocities, gravity and scale from poses (n,4,4), n >= 4, by linear least squares; None when it is degenerate.

    T_m_b: poses whose *camera* positions are exact up to scale: p_c = p_b + R p_b_c with p_b_c (3,) in metres, so with a
    scale s the body lies at s p_c - R p_b_c. bias: (6,) to be used. The accelerometer's bias is not estimated here.
    """
    n = len(T_m_b)
    free_gravity = 3 * n + (1 if with_scale else 0)
    camera = T_m_b[:, :3, 3] + T_m_b[:, :3, :3] @ p_b_c
    offset = T_m_b[:, :3, :3] @ p_b_c
    size = free_gravity + 3
    rows = 6 * (n - 1)
    a, b, weight = np.zeros((rows, size)), np.zeros(rows), np.zeros(rows)
    for k, motion in enumerate(motions):
        _, vp = motion.corrected(bias)
        r, dt = T_m_b[k, :3, :3], motion.dt_s
        # s (c1 - c0) - (o1 - o0) = v0 dt + g dt^2 / 2 + R dp, divided by dt to weigh like a velocity
        top, low = slice(6 * k, 6 * k + 3), slice(6 * k + 3, 6 * k + 6)
        a[top, 3 * k : 3 * k + 3] = np.eye(3)
        a[top, free_gravity:] = 0.5 * dt * np.eye(3)
        moved = (camera[k + 1] - camera[k]) / dt
        b[top] = -(r @ vp[3:] + offset[k + 1] - offset[k]) / dt
        if with_scale:
            a[top, 3 * n] = -moved
        else:
            b[top] += moved
        # v1 - v0 = g dt + R dv
        a[low, 3 * k + 3 : 3 * k + 6] = np.eye(3)
        a[low, 3 * k : 3 * k + 3] = -np.eye(3)
        a[low, free_gravity:] = -dt * np.eye(3)
        b[low] = r @ vp[:3]
        weight[top], weight[low] = 1.0, 10.0  # images measure a velocity over one frame worse than the IMU its change
    x, _, rank, _ = np.linalg.lstsq(a * weight[:, None], b * weight, rcond=1e-9)
    gravity = x[free_gravity:]
    length = float(np.linalg.norm(gravity))
    if rank < size or not 0.3 * gravity_m_s2 < length < 3.0 * gravity_m_s2:
        return None
    # impose the length: gravity = g0 (unit + basis @ w), twice
    unit = gravity / length
    inverse = np.zeros((size - 1, size - 1))
    for _ in range(3):
        basis = np.linalg.svd(unit[None, :])[2][1:].T
        reduced = np.concatenate([a[:, :free_gravity], gravity_m_s2 * a[:, free_gravity:] @ basis], axis=1)
        reduced = reduced * weight[:, None]
        right = (b - gravity_m_s2 * a[:, free_gravity:] @ unit) * weight
        normal = reduced.T @ reduced
        if np.linalg.cond(normal) > 1e14:
            return None
        inverse = np.linalg.inv(normal)
        x = inverse @ (reduced.T @ right)
        unit = unit + basis @ x[free_gravity:]
        unit = unit / np.linalg.norm(unit)
    rest = reduced @ x - right
    variance = float(rest @ rest) / max(rows - size + 1, 1)
    scale = float(x[3 * n]) if with_scale else 1.0
    if scale <= 0.0:
        return None
    sigma = float(np.sqrt(variance * inverse[3 * n, 3 * n])) if with_scale else 0.0
    residual = float(np.sqrt(np.mean((rest[weight == 1.0]) ** 2)))
    return Alignment(
        x[: 3 * n].reshape(n, 3), gravity_m_s2 * unit, scale, sigma, residual, abs(length / gravity_m_s2 - 1.0)
    )

"""Projection by a vector of intrinsics (fx, fy, cx, cy, coefficients of the lens); its derivatives by differences."""

import cv2
import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import Lens

_NEWTON_STEPS = 12


def project(lens: Lens, v: F64, points: F64) -> F64:
    """Pixels (n, 2) of points (n, 3) in the camera; an equidistant lens also sees what is beside and behind it."""
    x, y, z = points.T
    d = v[4:]
    if lens is Lens.EQUIDISTANT:
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        t2 = theta * theta
        bent = theta * (1.0 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3]))))
        scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0 / np.where(np.abs(z) > 1e-12, z, 1e-12))
        a, b = x * scale, y * scale
    else:
        z = np.where(np.abs(z) > 1e-9, z, 1e-9)
        x, y = x / z, y / z
        r2 = x * x + y * y
        k = np.zeros(8)
        k[: len(d)] = d
        radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        a = x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x)
        b = y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y
    return np.stack([v[0] * a + v[2], v[1] * b + v[3]], 1)


def derivatives(lens: Lens, v: F64, points: F64) -> tuple[F64, F64]:
    """Of pixels by intrinsics (n, 2, k) and by the point (n, 2, 3)."""
    by_v = np.empty((len(points), 2, len(v)))
    for i in range(len(v)):
        step = np.zeros_like(v)
        step[i] = 1e-4 if i < 4 else 1e-6
        by_v[:, :, i] = (project(lens, v + step, points) - project(lens, v - step, points)) / (2.0 * step[i])
    by_x = np.empty((len(points), 2, 3))
    size = 1e-6 * np.linalg.norm(points, axis=1).mean()
    for i in range(3):
        step = np.zeros(3)
        step[i] = size
        by_x[:, :, i] = (project(lens, v, points + step) - project(lens, v, points - step)) / (2.0 * size)
    return by_v, by_x


def rays(lens: Lens, v: F64, px: F64) -> F64:
    """Unit directions (n, 3) in which pixels (n, 2) look."""
    xy = (px - v[2:4]) / v[:2]
    if lens is not Lens.EQUIDISTANT:
        if v[4:].any():
            K = np.array([[v[0], 0.0, v[2]], [0.0, v[1], v[3]], [0.0, 0.0, 1.0]])
            xy = np.asarray(cv2.undistortPoints(px[:, None], K, v[4:]), np.float64).reshape(-1, 2)
            for _ in range(_NEWTON_STEPS):  # OpenCV stops early
                ideal = np.concatenate([xy, np.ones((len(xy), 1))], 1)
                xy = xy - (project(lens, v, ideal) - px) / v[:2]
        out = np.concatenate([xy, np.ones((len(xy), 1))], 1)
        return np.asarray(out / np.linalg.norm(out, axis=1)[:, None], np.float64)
    bent = np.linalg.norm(xy, axis=1)
    k1, k2, k3, k4 = v[4:]
    theta = bent.copy()
    for _ in range(_NEWTON_STEPS):
        t2 = theta * theta
        value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - bent
        slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
        theta = np.clip(theta - value / np.maximum(slope, 0.1), 0.0, np.pi)
    across = xy / np.maximum(bent, 1e-12)[:, None] * np.sin(theta)[:, None]
    return np.concatenate([across, np.cos(theta)[:, None]], 1)

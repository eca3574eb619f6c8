"""Inertial steps of a body that flies a curve."""

from itertools import pairwise
from typing import Any

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

GRAVITY = np.array([0.0, 0.0, -9.81])
T_B_C = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.02, -0.05]))
FINE = 1e-2  # s between two samples


def body(t: float, lively: float) -> F64:
    """T_w_b (4,4) of a flight with accelerations of about 0.5 m/s^2 times `lively`."""
    p = np.array([0.3 * np.sin(1.9 * t), 0.35 * np.sin(1.3 * t + 1.0), 0.2 * np.sin(2.3 * t + 0.4)])
    turn = np.array([0.08 * np.sin(1.1 * t), 0.1 * np.sin(1.6 * t + 0.3), 0.2 * np.sin(0.7 * t)])
    return se3.from_rt(se3.so3_exp(turn), lively * p + np.array([0.3 * t, 0.1 * t, 0.0]))


def steps(
    from_s: float, to_s: float, n: int, lively: float, scale: float, rng: np.random.Generator, bias: F64
) -> dict[str, Any]:
    """The fields of steps: images see `scale` times the true lengths with 1 mm of noise, the IMU has noise and bias."""
    edges = np.linspace(from_s, to_s, n + 1)
    rows: dict[str, list[Any]] = {name: [] for name in ("dt_s", "turn", "moved", "velocity", "position")}
    for a, b in pairwise(edges):
        T0, T1 = body(a, lively), body(b, lively)
        C = se3.inverse(T0 @ T_B_C) @ (T1 @ T_B_C)
        C[:3, 3] = scale * C[:3, 3] + rng.normal(0.0, 1e-3, 3)
        seen = T_B_C @ C @ se3.inverse(T_B_C)
        v, p = np.zeros(3), np.zeros(3)
        m = max(2, round((b - a) / FINE))
        h = (b - a) / m
        for k in range(m):
            t = a + (k + 0.5) * h
            second = (body(t + h, lively) - 2.0 * body(t, lively) + body(t - h, lively))[:3, 3] / h**2
            noise = rng.normal(0.0, 2e-3 / np.sqrt(h), 3)
            force = T0[:3, :3].T @ (second - GRAVITY) + T0[:3, :3].T @ body(t, lively)[:3, :3] @ (bias + noise)
            p += v * h + 0.5 * force * h * h
            v += force * h
        turn = se3.so3_log(seen[:3, :3])
        for name, value in zip(rows, (b - a, turn, seen[:3, 3], v, p), strict=True):
            rows[name].append(value)
    return {name: np.array(values) for name, values in rows.items()}

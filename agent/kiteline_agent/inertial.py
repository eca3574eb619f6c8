"""Which way is up, from an accelerometer alone: good at rest, a guess in motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core import se3

F64 = NDArray[np.float64]


def level_rotation(accel: F64) -> F64:
    """R_m_b (3,3) with z up and yaw zero, from the mean specific force (3,) in the body, which points up at rest."""
    up = accel / np.linalg.norm(accel)
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(up, z)
    s, c = float(np.linalg.norm(axis)), float(up @ z)
    if s < 1e-9:
        return np.eye(3) if c > 0 else np.diag([1.0, -1.0, -1.0])
    return se3.so3_exp(axis / s * np.arctan2(s, c))

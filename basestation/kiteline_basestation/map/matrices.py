"""Poses (4,4) as 16 numbers in JSON, row by row, to the last bit."""

from collections.abc import Sequence

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import sim3

_MOST = 1e9  # of a number in a matrix
_TOLERANCE = 1e-6  # of a rotation matrix


def numbers_of(pose: F64 | None) -> list[float] | None:
    """The 16 numbers of a matrix (4,4), row by row."""
    return None if pose is None else [float(x) for x in pose.ravel()]


def _matrix(numbers: Sequence[float] | F64) -> F64:
    """(4,4) of 16 numbers, whose products are finite. Raises ValueError."""
    values = np.array(numbers, np.float64).reshape(4, 4)
    if not (np.abs(values) <= _MOST).all():
        raise ValueError("numbers too large")
    return values


def similarity_from(numbers: Sequence[float] | F64) -> F64:
    """S (4,4) from 16 numbers. Raises ValueError if it is no similarity."""
    S = _matrix(numbers)
    scale = sim3.scale_of(S) if np.isfinite(S).all() else 0.0
    if scale <= 0.0:
        raise ValueError("no similarity")
    rigid_from(S if scale == 1.0 else sim3.rigid(S))
    if scale != 1.0 and np.abs(S[:3, :3] @ S[:3, :3].T / scale**2 - np.eye(3)).max() > _TOLERANCE:
        raise ValueError("no similarity")
    return S


def rigid_from(numbers: Sequence[float] | F64) -> F64:
    """T (4,4) from 16 numbers. Raises ValueError if it is no rigid motion."""
    T = _matrix(numbers)
    R = T[:3, :3]
    if not np.isfinite(T).all() or np.abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError("no rigid motion")
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError("no rigid motion")
    return T

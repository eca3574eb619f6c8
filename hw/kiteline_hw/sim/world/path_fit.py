"""Fits paths to trajectories: penalised least-squares B-splines, and the reader of TUM and KITTI trajectory files.

The penalty is on third differences of the coefficients (P. Eilers, B. Marx, "Flexible smoothing with B-splines and
penalties", 1996).
"""

import warnings
from pathlib import Path as FilePath

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.world.path import BASIS, ORDER, Path

# Rotates KITTI's world (x right, y down, z forward) to a world with z up.
_R_UP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def fit(t_s: F64, poses: F64, knot_s: float, smoothing: float) -> Path:
    """Least-squares path through body poses T_w_b (n, 4, 4) at times (n,) that start at 0.

    smoothing: weight of the squared third differences of the coefficients, relative to one mean data row per knot.
    """
    q = np.array([se3.quaternion_numbers(T[:3, :3]) for T in poses])
    signs = np.cumprod(np.concatenate([[1.0], np.where((q[1:] * q[:-1]).sum(1) < 0, -1.0, 1.0)]))
    data = np.concatenate([poses[:, :3, 3], q * signs[:, None]], 1)
    length = float(t_s[-1])
    segments = max(1, int(np.ceil(length / knot_s)))
    count = segments + ORDER - 1
    x = t_s / knot_s
    k = np.minimum(x.astype(np.int64), segments - 1)
    w = ((x - k)[:, None] ** np.arange(ORDER)) @ BASIS
    band = np.zeros((count, ORDER))  # band[i, j] is the element (i + j, i)
    right = np.zeros((count, 7))
    weight = segments / len(t_s)
    for a in range(ORDER):
        np.add.at(right, k + a, weight * w[:, a : a + 1] * data)
        for b in range(a, ORDER):
            np.add.at(band[:, b - a], k + a, weight * w[:, a] * w[:, b])
    third = np.array([-1.0, 3.0, -3.0, 1.0])
    for a in range(4):
        for b in range(a, 4):
            band[a : count - 3 + a, b - a] += smoothing * third[a] * third[b]
    band[:, 0] += 1e-12
    return Path(_solve_banded(band, right), knot_s, length)


def _solve_banded(band: F64, right: F64) -> F64:
    """Solve a symmetric positive system by Cholesky; band (n, m): diagonal and sub-diagonals."""
    n, m = band.shape
    a = band.copy()
    for i in range(n):
        a[i] /= np.sqrt(a[i, 0])
        for j in range(1, min(m, n - i)):
            a[i + j, : m - j] -= a[i, j] * a[i, j:]
    x = right.copy()
    for i in range(n):
        x[i] /= a[i, 0]
        reach = min(m, n - i)
        x[i + 1 : i + reach] -= a[i, 1:reach, None] * x[i]
    for i in range(n - 1, -1, -1):
        reach = min(m, n - i)
        x[i] = (x[i] - a[i, 1:reach] @ x[i + 1 : i + reach]) / a[i, 0]
    return x


def read_trajectory(file: FilePath, camera_in_body: F64) -> Path:
    """Fit a path to a TUM or KITTI file.

    TUM: t x y z qx qy qz qw, body poses, z up. KITTI: 3x4 rows, camera poses, y down.
    camera_in_body: T_b_c (4, 4), to convert KITTI's camera poses to body poses. Raises SourceError.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty file is reported below
            rows = np.loadtxt(file, ndmin=2, comments="#")
    except OSError as error:
        raise SourceError(f"trajectory {file} cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise SourceError(f"trajectory {file} is no table of numbers: {error}") from error
    if rows.shape[1] not in (8, 12) or rows.shape[0] < 10 or not np.isfinite(rows).all():
        raise SourceError(
            f"trajectory {file} has {rows.shape[0]} rows of {rows.shape[1]} numbers: expected at least 10 finite rows "
            "of 8 (TUM: t x y z qx qy qz qw) or 12 (KITTI: 3x4 matrix)"
        )
    if rows.shape[1] == 12:
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3] = rows.reshape(-1, 3, 4)
        poses = se3.from_rt(_R_UP, np.zeros(3)) @ poses @ se3.inverse(camera_in_body)
        return fit(np.asarray(0.1 * np.arange(len(rows)), np.float64), poses, 0.2, 0.3)
    t = rows[:, 0] - rows[0, 0]
    if not (np.diff(t) > 0).all():
        raise SourceError(f"trajectory {file}: times must increase from row to row")
    poses = se3.from_quaternions(rows[:, [7, 4, 5, 6]], rows[:, 1:4])
    return fit(t, poses, max(0.08, 1.5 * float(np.median(np.diff(t)))), 0.02)

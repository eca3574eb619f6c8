"""Motion as a quintic B-spline: poses, velocities and accelerations that belong together exactly.

Position and (sign-continuous, not normalised) quaternion are least-squares splines over uniform knots with a penalty on
third differences; rates follow analytically (L. Piegl, W. Tiller, "The NURBS Book"; P. Eilers, B. Marx, "Flexible
smoothing with B-splines and penalties", 1996). A path starts at rest: time is warped by a quintic ease-in.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from math import comb, factorial
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3
from kiteline_hw.ports import SourceError

F64 = NDArray[np.float64]

GRAVITY = 9.81  # m/s^2
REST_S = 1.0  # standing still at the start
EASE_S = 1.5  # from standstill to the speed of the recording
_ORDER = 6
# World z up from KITTI's world (x right, y down, z forward).
_R_UP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def _basis() -> F64:
    """Powers of u (rows) to the six weights (columns) of a uniform quintic B-spline segment."""
    n = _ORDER
    m = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            total = sum((-1.0) ** (s - j) * comb(n, s - j) * (n - s - 1.0) ** (n - 1 - i) for s in range(j, n))
            m[i, j] = comb(n - 1, i) * total / factorial(n - 1)
    return m


_BASIS = _basis()


@dataclass(frozen=True, slots=True)
class Motion:
    """Body motion at n instants. T_w_b (n, 4, 4); velocity, acceleration (n, 3) in w; rate (n, 3) rad/s in b."""

    T_w_b: F64
    velocity: F64
    acceleration: F64
    rate: F64


@dataclass(frozen=True, slots=True)
class Path:
    """A spline over [0, length_s] of the source's time, entered from rest.

    coefficients (k, 7): x y z, then quaternion w x y z. knot_s: distance of the knots. rest_s 0 means no ease-in.
    """

    coefficients: F64
    knot_s: float
    length_s: float
    start_s: float = 0.0
    rest_s: float = REST_S

    @property
    def duration_s(self) -> float:
        """How long the flight takes, rest included."""
        lead = self.rest_s + 0.5 * EASE_S if self.rest_s > 0 else 0.0
        return self.length_s - self.start_s + lead

    def motion(self, t_s: F64) -> Motion:
        """Body motion at flight times (n,) in seconds."""
        s, ds, dds = self._warp(np.asarray(t_s, np.float64))
        value, first, second = self._evaluate(s)
        n = s.shape[0]
        q = value[:, 3:]
        norm2 = (q * q).sum(1)
        t = np.tile(np.eye(4), (n, 1, 1))
        t[:, :3, :3] = _rotations(q / np.sqrt(norm2)[:, None])
        t[:, :3, 3] = value[:, :3]
        velocity = first[:, :3] * ds[:, None]
        acceleration = second[:, :3] * (ds**2)[:, None] + first[:, :3] * dds[:, None]
        w, v = q[:, :1], q[:, 1:]
        dw, dv = first[:, 3:4], first[:, 4:]
        rate = 2.0 * (w * dv - dw * v - np.cross(v, dv)) / norm2[:, None] * ds[:, None]
        return Motion(t, velocity, acceleration, rate)

    def positions(self, spacing_m: float = 0.1) -> F64:
        """Points (n, 3) along the whole path, at most about `spacing_m` apart, for building a world around it."""
        s = np.linspace(0.0, self.length_s, max(2, int(self.length_s / 0.01)))
        p = self._evaluate(s)[0][:, :3]
        travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
        keep = np.unique(np.searchsorted(travelled, np.arange(0.0, travelled[-1] + spacing_m, spacing_m)))
        return np.asarray(p[np.minimum(keep, len(p) - 1)])

    def _warp(self, t: F64) -> tuple[F64, F64, F64]:
        """Source time and its first two derivatives by flight time."""
        if self.rest_s <= 0:
            return t + self.start_s, np.ones_like(t), np.zeros_like(t)
        x = np.clip((t - self.rest_s) / EASE_S, 0.0, 1.0)
        late = np.maximum(t - self.rest_s - EASE_S, 0.0)
        s = EASE_S * x**4 * (2.5 - 3.0 * x + x * x) + late
        return s + self.start_s, x**3 * (10 - 15 * x + 6 * x * x), 30 * x**2 * (1 - x) ** 2 / EASE_S

    def _evaluate(self, s: F64) -> tuple[F64, F64, F64]:
        x = np.clip(s, 0.0, self.length_s) / self.knot_s
        k = np.minimum(x.astype(np.int64), self.coefficients.shape[0] - _ORDER)
        u = x - k
        c = self.coefficients[k[:, None] + np.arange(_ORDER)]
        p = np.arange(_ORDER)
        w0 = u[:, None] ** p
        w1 = np.where(p > 0, p * u[:, None] ** np.maximum(p - 1, 0), 0.0) / self.knot_s
        w2 = np.where(p > 1, p * (p - 1) * u[:, None] ** np.maximum(p - 2, 0), 0.0) / self.knot_s**2
        value, first, second = (np.einsum("nj,njd->nd", w @ _BASIS, c) for w in (w0, w1, w2))
        return value, first, second


def fit(t_s: F64, poses: F64, knot_s: float, smoothing: float) -> Path:
    """Least-squares path through body poses T_w_b (n, 4, 4) at times (n,) that start at 0.

    smoothing: weight of the squared third differences of the coefficients against one mean data row per knot.
    """
    q = np.array([se3.quaternion_from_rotation(r) for r in poses[:, :3, :3]])
    signs = np.cumprod(np.concatenate([[1.0], np.where((q[1:] * q[:-1]).sum(1) < 0, -1.0, 1.0)]))
    data = np.concatenate([poses[:, :3, 3], q * signs[:, None]], 1)
    length = float(t_s[-1])
    segments = max(1, int(np.ceil(length / knot_s)))
    count = segments + _ORDER - 1
    x = t_s / knot_s
    k = np.minimum(x.astype(np.int64), segments - 1)
    w = ((x - k)[:, None] ** np.arange(_ORDER)) @ _BASIS
    band = np.zeros((count, _ORDER))  # band[i, j] is the element (i + j, i)
    right = np.zeros((count, 7))
    weight = segments / len(t_s)
    for a in range(_ORDER):
        np.add.at(right, k + a, weight * w[:, a : a + 1] * data)
        for b in range(a, _ORDER):
            np.add.at(band[:, b - a], k + a, weight * w[:, a] * w[:, b])
    third = np.array([-1.0, 3.0, -3.0, 1.0])
    for a in range(4):
        for b in range(a, 4):
            band[a : count - 3 + a, b - a] += smoothing * third[a] * third[b]
    band[:, 0] += 1e-12
    return Path(_solve_banded(band, right), knot_s, length)


def _solve_banded(band: F64, right: F64) -> F64:
    """Cholesky solution for a symmetric positive matrix given by its diagonal and sub-diagonals (n, m)."""
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


def _rotations(q: F64) -> F64:
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def read_trajectory(file: FilePath, camera_in_body: F64) -> Path:
    """The path of a TUM file (t x y z qx qy qz qw, body poses, z up) or a KITTI file (3x4 rows, camera poses, y down).

    camera_in_body: T_b_c (4, 4), which turns KITTI's camera poses into body poses. Raises SourceError.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty file is told of below
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
        turn = se3.from_rt(_R_UP, np.zeros(3))
        poses = turn @ poses @ se3.inverse(camera_in_body)
        return fit(np.asarray(0.1 * np.arange(len(rows)), np.float64), poses, 0.2, 0.3)
    t = rows[:, 0] - rows[0, 0]
    if not (np.diff(t) > 0).all():
        raise SourceError(f"trajectory {file}: times must increase from row to row")
    poses = np.array([se3.from_quaternion(r[[7, 4, 5, 6]], r[1:4]) for r in rows])
    return fit(t, poses, max(0.08, 1.5 * float(np.median(np.diff(t)))), 0.02)


def to_trajectory(path: Path, t_ns: NDArray[np.int64], start_ns: int) -> Trajectory:
    """Ground truth at the stamps t_ns (n,), where `start_ns` is flight time zero."""
    return Trajectory(t_ns, path.motion(flight_s(t_ns, start_ns)).T_w_b)


def flight_s(t_ns: NDArray[np.int64], start_ns: int) -> F64:
    """Flight times in seconds of stamps (n,)."""
    return np.asarray((t_ns - start_ns) * 1e-9, np.float64)

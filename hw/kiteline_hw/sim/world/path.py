"""Motion as a quintic B-spline: poses, velocities and accelerations that are exactly consistent.

Position and (sign-continuous, not normalised) quaternion are splines over uniform knots; rates follow analytically
(L. Piegl, W. Tiller, "The NURBS Book"). A path starts at rest: time is warped by a quintic ease-in.
"""

from dataclasses import dataclass
from math import comb, factorial

import numpy as np

from kiteline_core.arrays import F64, I64
from kiteline_core.frame import Trajectory

GRAVITY = 9.81  # m/s^2
REST_S = 1.0  # s at rest at the start
EASE_S = 1.5  # s from rest to the speed of the recording
ORDER = 6


def _basis() -> F64:
    """Matrix (6,6) from powers of u (rows) to the weights (columns) of a uniform quintic B-spline segment."""
    n = ORDER
    m = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            total = sum((-1.0) ** (s - j) * comb(n, s - j) * (n - s - 1.0) ** (n - 1 - i) for s in range(j, n))
            m[i, j] = comb(n - 1, i) * total / factorial(n - 1)
    return m


BASIS = _basis()


@dataclass(frozen=True, slots=True)
class Motion:
    """Body motion at n instants. T_w_b (n, 4, 4); velocity, acceleration (n, 3) in w; rate (n, 3) rad/s in b."""

    T_w_b: F64
    velocity: F64
    acceleration: F64
    rate: F64


@dataclass(frozen=True, slots=True)
class Path:
    """A spline over [0, length_s] of the recording's time, started from rest.

    coefficients (k, 7): x y z, then quaternion w x y z. knot_s: knot spacing. rest_s: 0 for no ease-in.
    """

    coefficients: F64
    knot_s: float
    length_s: float
    start_s: float = 0.0
    rest_s: float = REST_S

    @property
    def duration_s(self) -> float:
        """Duration of the flight, rest included."""
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
        """Points (n, 3) along the whole path, at most about `spacing_m` apart."""
        s = np.linspace(0.0, self.length_s, max(2, int(self.length_s / 0.01)))
        p = self._evaluate(s)[0][:, :3]
        travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
        keep = np.unique(np.searchsorted(travelled, np.arange(0.0, travelled[-1] + spacing_m, spacing_m)))
        return np.asarray(p[np.minimum(keep, len(p) - 1)])

    def _warp(self, t: F64) -> tuple[F64, F64, F64]:
        """Recording time and its first two derivatives by flight time."""
        if self.rest_s <= 0:
            return t + self.start_s, np.ones_like(t), np.zeros_like(t)
        x = np.clip((t - self.rest_s) / EASE_S, 0.0, 1.0)
        late = np.maximum(t - self.rest_s - EASE_S, 0.0)
        s = EASE_S * x**4 * (2.5 - 3.0 * x + x * x) + late
        return s + self.start_s, x**3 * (10 - 15 * x + 6 * x * x), 30 * x**2 * (1 - x) ** 2 / EASE_S

    def _evaluate(self, s: F64) -> tuple[F64, F64, F64]:
        """The spline's values (n, 7) and first two derivatives at recording times (n,)."""
        x = np.clip(s, 0.0, self.length_s) / self.knot_s
        k = np.minimum(x.astype(np.int64), self.coefficients.shape[0] - ORDER)
        u = x - k
        c = self.coefficients[k[:, None] + np.arange(ORDER)]
        p = np.arange(ORDER)
        w0 = u[:, None] ** p
        w1 = np.where(p > 0, p * u[:, None] ** np.maximum(p - 1, 0), 0.0) / self.knot_s
        w2 = np.where(p > 1, p * (p - 1) * u[:, None] ** np.maximum(p - 2, 0), 0.0) / self.knot_s**2
        value, first, second = (np.einsum("nj,njd->nd", w @ BASIS, c) for w in (w0, w1, w2))
        return value, first, second


def _rotations(q: F64) -> F64:
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4)."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def to_trajectory(path: Path, t_ns: I64, start_ns: int) -> Trajectory:
    """Ground truth at the stamps t_ns (n,), where `start_ns` is flight time zero."""
    return Trajectory(t_ns, path.motion(flight_s(t_ns, start_ns)).T_w_b)


def flight_s(t_ns: I64, start_ns: int) -> F64:
    """Flight times in seconds of stamps (n,)."""
    return np.asarray((t_ns - start_ns) * 1e-9, np.float64)

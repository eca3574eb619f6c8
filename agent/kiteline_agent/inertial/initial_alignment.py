"""Start in motion: gyro bias, velocity, gravity and, without stereo, the scale of a map from poses and IMU.

The IMU hardly errs over a second, so a window has few unknowns: place and velocity at its begin, gravity,
accelerometer bias and scale, all linear (A. Martinelli, "Closed-form solution of visual-inertial structure from
motion", 2014). The gyro bias and the refinement that imposes the length of gravity are those of T. Qin et al.,
"VINS-Mono", 2018, section V-B.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kiteline_agent.inertial.preintegration import Preintegrated
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

# Columns of the unknowns: first position, then these. With the length of gravity imposed, its two turns and q = 1 / s.
_VELOCITY, _BIAS, _GRAVITY, _TURNS, _Q = slice(3, 6), slice(6, 9), slice(9, 12), slice(9, 11), 11
_MIN_POSES = 5
_POSITION_SIGMA_M = 0.003  # of a position by images
_ACCEL_BIAS_SIGMA = 0.1  # m/s^2, of the first guess
_ITERATIONS = 8  # of the direction of gravity, each one least-squares solve
_RANK_TOL = 1e-10  # singular values below it, over the largest, leave an unknown open: poses at rest
_GRAVITY_RANGE = 0.3, 3.0  # times the true length: beyond, poses and IMU do not belong together
_MIN_RESIDUAL = 1e-5  # m: an exact fit of few poses does not make the scale exact


@dataclass(frozen=True, slots=True)
class ImuAlignment:
    """Result of `align`.

    velocities: (n,3) m/s in m of every pose. gravity: (3,) m/s^2 in m. accel_bias: (3,) m/s^2. scale: metres per unit
    of the map. scale_sigma: its standard deviation, 0 if not estimated. residual_m: rms of the positions.
    gravity_error: relative error of gravity's length, found without imposing it; 0 where the scale is estimated.
    """

    velocities: F64
    gravity: F64
    accel_bias: F64
    scale: float
    scale_sigma: float
    residual_m: float
    gravity_error: float


def gyro_bias(T_m_b: F64, motions: list[Preintegrated]) -> F64:
    """Gyro bias (3,) rad/s that fits the n-1 motions to the rotations of the poses T_m_b (n,4,4)."""
    bias = motions[0].bias[:3].copy()
    for _ in range(2):
        h, g = np.zeros((3, 3)), np.zeros(3)
        for k, motion in enumerate(motions):
            rotation, _ = motion.corrected(np.concatenate([bias, motion.bias[3:]]))
            error = se3.so3_log(rotation.T @ T_m_b[k, :3, :3].T @ T_m_b[k + 1, :3, :3])
            j = motion.jac[:3, :3]
            h += j.T @ j
            g += j.T @ error
        bias = bias + np.linalg.solve(h, g)
    return bias


@dataclass(frozen=True, slots=True)
class _Integrated:
    """Accelerometer integrated from zero velocity at the first of n poses, in m, without gravity.

    times: (n,) s. v, p: (n,3) m/s and m. jv, jp: (n,3,3) derivatives by the accelerometer's bias.
    """

    times: F64
    v: F64
    p: F64
    jv: F64
    jp: F64


def _integrated(T_m_b: F64, motions: list[Preintegrated], bias: F64) -> _Integrated:
    n = len(T_m_b)
    times, v, p = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3))
    jv, jp = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    for k, motion in enumerate(motions):
        _, vp = motion.corrected(bias)
        r, dt = T_m_b[k, :3, :3], motion.dt_s
        times[k + 1] = times[k] + dt
        p[k + 1], v[k + 1] = p[k] + v[k] * dt + r @ vp[3:], v[k] + r @ vp[:3]
        jp[k + 1], jv[k + 1] = jp[k] + jv[k] * dt + r @ motion.jac[6:, 3:], jv[k] + r @ motion.jac[3:6, 3:]
    return _Integrated(times, v, p, jv, jp)


def align(
    T_m_b: F64,
    p_b_c: F64,
    motions: list[Preintegrated],
    bias: F64,
    gravity_m_s2: float,
    *,
    with_scale: bool,
) -> ImuAlignment | None:
    """Velocities, gravity, accelerometer bias and scale from n >= 5 poses by least squares; None if degenerate.

    T_m_b: (n,4,4) poses. The *camera* is at s p_c, p_c = p_b + R p_b_c, with p_b_c (3,) in metres, and the body at
    s p_c - R p_b_c. motions: the n - 1 between them. bias: (6,) first guess.
    """
    n = len(T_m_b)
    if n < _MIN_POSES:
        return None
    rotated = T_m_b[:, :3, :3] @ p_b_c
    camera = (T_m_b[:, :3, 3] + rotated).reshape(-1)
    by_imu = _integrated(T_m_b, motions, bias)
    integrated = (rotated + by_imu.p).reshape(-1)
    free = _derivatives(by_imu)
    bias_weight = _POSITION_SIGMA_M / _ACCEL_BIAS_SIGMA
    if with_scale:
        up, length = by_imu.v[-1], gravity_m_s2  # in the mean, an accelerometer measures the opposite of gravity
        unit = -up / float(np.linalg.norm(up))
    else:
        gravity = _free_gravity(free, camera - integrated, bias_weight)
        length = float(np.linalg.norm(gravity))
        if not _GRAVITY_RANGE[0] * gravity_m_s2 < length < _GRAVITY_RANGE[1] * gravity_m_s2:
            return None
        unit = gravity / length
    found = _with_gravity_of_length(free, camera, integrated, unit, gravity_m_s2, bias_weight, with_scale=with_scale)
    if found is None:
        return None
    x, q = found.x, found.q
    rest = found.a @ x - found.b
    gravity, change = gravity_m_s2 * found.unit, x[_BIAS] / q
    velocities = x[_VELOCITY] / q + by_imu.times[:, None] * gravity + by_imu.v + by_imu.jv @ change
    sigma = 0.0
    if with_scale:
        variance = max(float(rest @ rest) / (3 * n - 9), (_MIN_RESIDUAL * q) ** 2)
        sigma = float(np.sqrt(variance * np.linalg.inv(found.a.T @ found.a)[_Q, _Q])) / q**2
    residual = float(np.sqrt(np.mean(rest[: 3 * n] ** 2))) / q
    error = abs(length / gravity_m_s2 - 1.0)
    return ImuAlignment(velocities, gravity, bias[3:] + change, 1.0 / q, sigma, residual, error)


def _derivatives(by_imu: _Integrated) -> F64:
    """Derivatives (3n,12) of n positions by the first one, the first velocity, the bias and gravity.

    With q = 1 / s the noisy positions are alone on one side of the equations, so that noise does not bias the scale:
    p_c = p0 q + v0 q t + gravity q t^2 / 2 + jp bias q + integrated q.
    """
    times = by_imu.times[:, None]
    columns = (
        np.tile(np.eye(3), (len(times), 1)), np.kron(times, np.eye(3)), by_imu.jp.reshape(-1, 3),
        np.kron(0.5 * times**2, np.eye(3)),
    )  # fmt: skip
    return np.concatenate(columns, axis=1)


class _Solution(NamedTuple):
    """Unknowns x, with a x = b in the least squares. q: 1 / scale, 1 if it is known. unit: (3,) along gravity."""

    x: F64
    a: F64
    b: F64
    q: float
    unit: F64


def _with_gravity_of_length(
    free: F64, camera: F64, integrated: F64, unit: F64, length: float, bias_weight: float, *, with_scale: bool
) -> _Solution | None:
    """Solve with the length of gravity imposed; None if degenerate.

    free: see `_derivatives`. camera, integrated: (3n,) positions in the map's unit, and by the IMU in m. unit: (3,)
    first guess of gravity's direction. length: m/s^2. gravity q = length (q unit + basis w), w in the tangent plane.
    """
    q = 1.0
    for _ in range(_ITERATIONS):
        basis = np.linalg.svd(unit[None, :])[2][1:].T
        pull = integrated + length * free[:, _GRAVITY] @ unit
        a = np.concatenate([free[:, : _GRAVITY.start], length * free[:, _GRAVITY] @ basis], axis=1)
        b = camera - (0.0 if with_scale else pull)
        if with_scale:
            a = np.concatenate([a, pull[:, None]], axis=1)
        a, b = _with_bias_prior(a, b, bias_weight)
        x, _, rank, _ = np.linalg.lstsq(a, b, rcond=_RANK_TOL)
        if rank < a.shape[1]:
            return None
        q = float(x[_Q]) if with_scale else 1.0
        if q <= 0.0:
            return None
        rotated_unit = q * unit + basis @ x[_TURNS]
        unit = rotated_unit / float(np.linalg.norm(rotated_unit))
    return _Solution(np.asarray(x), a, b, q, np.asarray(unit, np.float64))


def _free_gravity(free: F64, positions: F64, bias_weight: float) -> F64:
    """Gravity (3,) of any length that fits the positions (3n,) in metres. free: (3n,12) their derivatives."""
    a, b = _with_bias_prior(free, positions, bias_weight)
    return np.asarray(np.linalg.lstsq(a, b, rcond=_RANK_TOL)[0][_GRAVITY])


def _with_bias_prior(a: F64, b: F64, weight: float) -> tuple[F64, F64]:
    """The equations a x = b, and three that hold the change of the bias near 0."""
    prior = np.zeros((3, a.shape[1]))
    prior[:, _BIAS] = weight * np.eye(3)
    return np.concatenate([a, prior]), np.append(b, np.zeros(3))

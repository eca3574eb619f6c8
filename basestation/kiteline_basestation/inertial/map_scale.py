"""The scale along a map by the accelerations of the whole flight.

Maximum a posteriori of position, velocity and accelerometer bias at the ends of short steps, of gravity's direction and
of the scale, given rotations and the shape of the path by images. As in C. Campos et al., "Inertial-only optimization
for visual-inertial initialization", 2020, but that positions are unknown too: images err by as much as a short step
accelerates, and taken as exact they would make the scale too small. Nor is it one scale: it drifts as the view changes
(`scale_drift`).
"""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_basestation.config import InertialScaleConfig
from kiteline_basestation.inertial import band_kernels
from kiteline_basestation.inertial.chain import MapPath, Segment, path_along, told_units
from kiteline_basestation.inertial.scale_drift import ScaleDrift, bent, drift_along, shared_landmarks
from kiteline_core.arrays import F64
from kiteline_core.optimisation.bundle import BundleProblem, BundleResult

_NODE = 9  # unknowns of a node: position, velocity, accelerometer bias
_SHARED = 2  # of the map: direction of gravity; and units of w in a metre at the knots of its drift
_ROWS = 12  # of a step: velocity and position by the IMU, displacement by images, change of the bias
_WIDTH = 2 * _NODE
_LEAST_S = 8.0  # s; time of all steps below which the agent's scale stands: it rests on as much
_NOISE_INFLATION = 3.0  # of the accelerometer's noise: vibration
_FLOOR_M_S = 2e-4  # m/s; of a step by the IMU: the code's quanta
_IMAGE_M = 5e-4  # m; error of a step by images, of near scenes
_BIAS_SIGMA = 0.3  # m/s^2; of the accelerometer's bias where a chain begins
_BIAS_WALK = (
    0.03  # m/s^2 per sqrt(s); slow errors of the accelerometer: axes, vibration, temperature, as true poses show them
)
_AGENT_SIGMA = 0.03  # relative deviation of the agent's scale
_ITERATIONS = 5  # of Gauss-Newton
_GRAVITY_M_S2 = 9.81  # m/s^2; differs by 0.3 % over the earth, which the accelerometer bias absorbs
_FLOOR_M = 3e-5  # m; of a step by the IMU: the code's quanta
_IMAGE_RAD = 5e-4  # rad; error of a step by images, over the distance of what they see


@dataclass(frozen=True, slots=True)
class MapScale:
    """metres: (k,) in one unit of w at each keyframe. sigma: standard deviation of the logarithm of their mean. chi2:
    mean squared residual by images.
    """

    metres: F64
    sigma: float
    chi2: float


@dataclass(slots=True)
class _State:
    """node: (k,9). gravity: (3,) m/s^2 in w. units: (m,) of w in a metre, at the knots."""

    node: F64
    gravity: F64
    units: F64


def in_metres(
    result: BundleResult, problem: BundleProblem, segments: tuple[Segment, ...], held: int, config: InertialScaleConfig
) -> BundleResult:  # fmt: skip
    """The result of a bundle, scaled from the camera `held` on by the scales of the segments, if that matters."""
    T_w_c: F64 = np.linalg.inv(result.T_c_m).astype(np.float64)
    shared = shared_landmarks(problem, result.inlier)
    found = map_scale(segments, T_w_c, shared, config)
    if found is None:
        return result
    result = replace(result, scale_sigma=found.sigma)
    if np.abs(np.log(found.metres)).max() < config.hold * found.sigma:
        return result
    return bent(result, problem, shared, found.metres, held)


def tells_scale(segments: tuple[Segment, ...]) -> bool:
    """True if the segments are long enough."""
    return sum(float(s.steps.dt_s.sum()) for s in segments) >= _LEAST_S


def map_scale(
    segments: tuple[Segment, ...], T_w_c: F64, shared: F64, config: InertialScaleConfig
) -> MapScale | None:  # fmt: skip
    """The scale at keyframes T_w_c (k,4,4) that share landmarks (k,k).

    None without steps, if they have no solution, and where the scale drifts by more than images allow: the map is torn.
    """
    if not segments or not np.isfinite(T_w_c).all():
        return None
    path = path_along(segments, T_w_c)
    drift = drift_along(segments, path, T_w_c, shared, config)
    state, weight = _start(path, drift), np.ones(len(path.begin))
    agent_units = told_units(segments, T_w_c)
    for _ in range(_ITERATIONS):
        J, e, chi2 = _linearised(path, drift, state, weight)
        solved = _solve(path, drift, state, J, e, agent_units)
        if solved is None:
            return None
        state, variance = solved
        if not (state.units.min() > 0.5 and state.units.max() < 2.0):
            return None
        weight = np.minimum(1.0, config.huber / np.sqrt(np.maximum(chi2, 1e-12)))
    if drift.largest_step(state.units) > config.most_drift:
        return None
    typical = max(1.0, float(np.median(chi2)) / _MEDIAN_3)
    mean = float(drift.mean @ state.units)
    metres = 1.0 / (drift.at_keyframes @ state.units)
    return MapScale(metres, float(np.sqrt(variance * typical)) / mean, float(np.mean(chi2)) / 3.0)


_MEDIAN_3 = 2.366  # of a chi-square with three degrees of freedom


def _start(path: MapPath, drift: ScaleDrift) -> _State:
    a, dt = path.begin, path.dt_s
    place = path.camera - path.lever
    velocity = np.zeros_like(place)
    velocity[a + 1] = (place[a + 1] - place[a]) / dt[:, None]
    first = a[path.fresh[a]]
    velocity[first] = velocity[first + 1]
    force = np.einsum("nij,nj->i", path.R_w_b[a], path.velocity) - (velocity[a + 1] - velocity[a]).sum(axis=0)
    gravity = -_GRAVITY_M_S2 * force / max(float(np.linalg.norm(force)), 1e-9)
    return _State(np.concatenate([place, velocity, np.zeros_like(place)], axis=1), gravity, np.ones(len(drift.mean)))


def _tangent(gravity: F64) -> F64:
    """Two directions (3,2) across gravity, as long as it."""
    u = gravity / np.linalg.norm(gravity)
    x = np.cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
    x /= np.linalg.norm(x)
    return np.asarray(np.column_stack([x, np.cross(u, x)]) * np.linalg.norm(gravity))


def _linearised(path: MapPath, drift: ScaleDrift, state: _State, weight: F64) -> tuple[F64, F64, F64]:
    """Jacobians (n,12,20+m) of whitened errors by two nodes and the shared unknowns, errors (n,12), and the squared
    errors (n,) of the images in deviations.
    """
    a, dt = path.begin, path.dt_s
    n, x0, x1 = len(a), state.node[path.begin], state.node[path.begin + 1]
    back = np.swapaxes(path.R_w_b[a], 1, 2)
    J = np.zeros((n, _ROWS, _WIDTH + _SHARED + len(drift.mean)))
    e = np.zeros((n, _ROWS))
    t = dt[:, None]
    dv = np.einsum("nij,nj->ni", back, x1[:, 3:6] - x0[:, 3:6] - t * state.gravity)
    dp = np.einsum("nij,nj->ni", back, x1[:, :3] - x0[:, :3] - t * x0[:, 3:6] - 0.5 * t * t * state.gravity)
    by_bias_v, by_bias_p = path.by_bias[:, 0], path.by_bias[:, 1]
    e[:, :3] = dv - path.velocity + np.einsum("nij,nj->ni", by_bias_v, x0[:, 6:])
    e[:, 3:6] = dp - path.position + np.einsum("nij,nj->ni", by_bias_p, x0[:, 6:])
    tilt = back @ _tangent(state.gravity)
    J[:, :3, 3:6], J[:, :3, 12:15], J[:, :3, 6:9] = -back, back, by_bias_v
    J[:, :3, 18:20] = -dt[:, None, None] * tilt
    J[:, 3:6, :3], J[:, 3:6, 9:12], J[:, 3:6, 3:6] = -back, back, -dt[:, None, None] * back
    J[:, 3:6, 6:9], J[:, 3:6, 18:20] = by_bias_p, -0.5 * (dt * dt)[:, None, None] * tilt
    moved = x1[:, :3] - x0[:, :3] + path.lever[a + 1] - path.lever[a]
    units = drift.at_steps @ state.units
    e[:, 6:9] = path.camera[a + 1] - path.camera[a] - units[:, None] * moved
    J[:, 6:9, :3], J[:, 6:9, 9:12] = units[:, None, None] * np.eye(3), -units[:, None, None] * np.eye(3)
    J[:, 6:9, 20:] = -moved[:, :, None] * drift.at_steps[:, None]
    e[:, 9:] = x1[:, 6:] - x0[:, 6:]
    J[:, 9:, 6:9], J[:, 9:, 15:18] = -np.eye(3), np.eye(3)
    # whitening: L L^T = inverse covariance of [velocity, position] by white noise
    density = _NOISE_INFLATION * path.noise
    v, vp, p = density**2 * dt, 0.5 * density**2 * dt**2, density**2 * dt**3 / 3.0
    v, p = v + _FLOOR_M_S**2, p + _FLOOR_M**2
    by_p = 1.0 / np.sqrt(p - vp**2 / v)
    position = by_p[:, None] * (e[:, 3:6] - (vp / v)[:, None] * e[:, :3])
    e[:, :3], e[:, 3:6] = e[:, :3] / np.sqrt(v)[:, None], position
    position_J = by_p[:, None, None] * (J[:, 3:6] - (vp / v)[:, None, None] * J[:, :3])
    J[:, :3], J[:, 3:6] = J[:, :3] / np.sqrt(v)[:, None, None], position_J
    image = 1.0 / np.hypot(_IMAGE_RAD * path.depth_m, _IMAGE_M)
    chi2 = np.square(image[:, None] * e[:, 6:9]).sum(axis=1)
    walk = 1.0 / (_BIAS_WALK * np.sqrt(dt))
    for rows, factor in ((slice(6, 9), image * np.sqrt(weight)), (slice(9, 12), walk)):
        e[:, rows] *= factor[:, None]
        J[:, rows] *= factor[:, None, None]
    return J, e, chi2


def _solve(
    path: MapPath, drift: ScaleDrift, state: _State, J: F64, e: F64, agent_units: float
) -> tuple[_State, float] | None:
    """A Gauss-Newton step, and the variance of the mean unit; None if the system has no solution."""
    k, shared = len(path.fresh), _SHARED + len(drift.mean)
    H, g = np.swapaxes(J, 1, 2) @ J, -np.einsum("nri,nr->ni", J, e)
    diagonal, beside = np.zeros((k, _NODE, _NODE)), np.zeros((k, _NODE, _NODE))
    border, rhs = np.zeros((k, _NODE, shared)), np.zeros((k, _NODE))
    a = path.begin
    for node, at in ((a, slice(0, _NODE)), (a + 1, slice(_NODE, _WIDTH))):  # each node once: plain indexing adds
        diagonal[node] += H[:, at, at]
        border[node] += H[:, at, _WIDTH:]
        rhs[node] += g[:, at]
    beside[a] = H[:, :_NODE, _NODE:_WIDTH]
    # where a chain begins: a place, and a first bias
    first = np.flatnonzero(path.fresh)
    diagonal[first, :3, :3] += np.eye(3) / _IMAGE_M**2
    diagonal[first, 6:, 6:] += np.eye(3) / _BIAS_SIGMA**2
    rhs[first, 6:] -= state.node[first, 6:] / _BIAS_SIGMA**2
    corner, corner_rhs = H[:, _WIDTH:, _WIDTH:].sum(axis=0), g[:, _WIDTH:].sum(axis=0)
    prior = np.outer(drift.mean, drift.mean) / (_AGENT_SIGMA * agent_units) ** 2 + drift.information
    corner[2:, 2:] += prior
    corner_rhs[2:] += prior @ (agent_units - state.units)
    band = np.zeros((k, _NODE, _WIDTH))
    for r in range(_NODE):
        band[:, r, : _NODE - r] = diagonal[:, r, r:]
        band[:, r, _NODE - r : _WIDTH - r] = beside[:, r]
    flat, flat_border, x = band.reshape(-1, _WIDTH), border.reshape(-1, shared), rhs.reshape(-1)
    if not band_kernels.factor(flat, flat_border, corner, x, corner_rhs):
        return None
    try:
        cov = np.linalg.inv(corner)
    except np.linalg.LinAlgError:
        return None
    step = cov @ corner_rhs
    band_kernels.substitute(flat, flat_border, x, step)
    variance = float(drift.mean @ cov[2:, 2:] @ drift.mean)
    if not (np.isfinite(x).all() and np.isfinite(cov).all() and variance > 0.0):
        return None
    gravity = state.gravity + _tangent(state.gravity) @ step[:2]
    gravity *= _GRAVITY_M_S2 / float(np.linalg.norm(gravity))
    moved = _State(state.node + x.reshape(k, _NODE), gravity, state.units + step[2:])
    return moved, variance

"""Drift of scale along a map of one camera, and how the map is bent by it.

Images tie the scale of a keyframe to that of others with the same landmarks, the less the more the view has changed
between them: on real flights lengths of a whole-map bundle grow or shrink by 2 to 4 % within a few views, mostly in
turns over a shallow scene. The scale is piecewise linear along the path, in views, with a random walk as its prior;
where the path comes back to landmarks, the two passes have nearly the same scale.
"""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_basestation.config import InertialScaleConfig
from kiteline_basestation.inertial.chain import MapPath, Segment
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry import se3
from kiteline_core.optimisation.bundle import BundleProblem, BundleResult

_TURN_RAD = 1.0  # rad by which the view has changed: what a usual lens sees
_CHAIN_VIEWS = 2.0  # from the end of a chain to the begin of the next one, wherever that is
_RETURN_VIEWS = 2.0  # between two keyframes that share landmarks from which the path has come back
_LEAST_SHARED = 20.0  # landmarks of two such keyframes
_LEAST_VIEWS = 0.1  # between two keyframes: no two have exactly the same scale
_WEAK = 1e-3  # landmarks by which a keyframe is tied to the next one beside those that they share
_REJECTED = 1e-6  # weight of a rejected observation: a landmark without others has to move, too
_NEAR_M = 0.01  # m; distance between keyframes below which all of them count alike
_KNOT_VIEWS = 1.0  # views between the values of a scale that drifts
_MOST_KNOTS = 16  # such values of a map


@dataclass(frozen=True, slots=True)
class ScaleDrift:
    """Scale along a path as weights of its values at m knots.

    at_steps: (n,m), at_keyframes: (k,m), mean: (m,) over the time of the path. information: (m,m) of the prior, none of
    the mean. sigma: (m-1,) deviation of the change from a knot to the next one.
    """

    at_steps: F64
    at_keyframes: F64
    mean: F64
    information: F64
    sigma: F64

    def largest_step(self, values: F64) -> float:
        """The largest change of values (m,) from a knot to the next one, in deviations."""
        return float(np.max(np.abs(np.diff(values)) / self.sigma, initial=0.0))


def shared_landmarks(problem: BundleProblem, inlier: Bool) -> F64:
    """Number (k,k) of points that two cameras of a bundle observe; 0 on the diagonal."""
    k = len(problem.T_c_m)
    point = np.repeat(np.arange(len(problem.points)), np.diff(problem.starts))[inlier]
    camera = problem.camera[inlier].astype(np.int64)
    counts = np.zeros(k * k, np.int64)
    for ahead in range(1, int(np.diff(problem.starts).max(initial=0))):
        same = point[ahead:] == point[:-ahead]
        if not same.any():
            break
        counts += np.bincount(camera[:-ahead][same] * k + camera[ahead:][same], minlength=k * k)
    out = counts.reshape(k, k).astype(np.float64)
    return out + out.T


def drift_along(
    segments: tuple[Segment, ...], path: MapPath, T_w_c: F64, shared: F64, config: InertialScaleConfig
) -> ScaleDrift:  # fmt: skip
    """The drift of scale along a path through keyframes T_w_c (k,4,4) that share landmarks (k,k)."""
    views = _views(path)
    gaps = min(int(np.ceil(views[-1] / _KNOT_VIEWS)), _MOST_KNOTS - 1)
    knots = np.linspace(0.0, float(views[-1]), gaps + 1)
    at_nodes = _interpolation(views, knots)
    keyframes, nodes, depth_m = _nodes_of_keyframes(segments, path)
    at_keyframes = np.full((len(T_w_c), len(knots)), np.nan)
    at_keyframes[keyframes] = at_nodes[nodes]
    sigma = config.drift * np.sqrt(np.diff(knots))
    steps = np.diff(np.eye(len(knots)), axis=0) / sigma[:, None]
    information = steps.T @ steps
    for i, j, apart in _returns(T_w_c[keyframes], shared[np.ix_(keyframes, keyframes)], views[nodes], depth_m):
        row = at_nodes[nodes[j]] - at_nodes[nodes[i]]
        information += np.outer(row, row) / (config.drift**2 * apart)
    at_steps = 0.5 * (at_nodes[path.begin] + at_nodes[path.begin + 1])
    mean = np.average(at_steps, axis=0, weights=path.dt_s)
    return ScaleDrift(at_steps, _spread(at_keyframes, shared), mean, information, sigma)


def bent(result: BundleResult, problem: BundleProblem, shared: F64, growth: F64, held: int) -> BundleResult:
    """The result of a bundle with lengths around each camera times its growth (k,); camera `held` stays.

    Rotations stay; positions are least squares of the displacements between cameras that share landmarks.
    """
    T_w_c: F64 = np.linalg.inv(result.T_c_m).astype(np.float64)
    place = T_w_c[:, :3, 3].copy()
    apart = place[None] - place[:, None]  # (i,j): from i to j
    weight = _tied(shared) / (np.square(apart).sum(axis=2) + _NEAR_M**2)
    laplacian = np.diag(weight.sum(axis=1)) - weight
    # solved for what differs from one common growth, so that this alone changes nothing else
    mean = float(np.exp(np.mean(np.log(growth))))
    more = 0.5 * (growth[:, None] + growth[None]) - mean
    rhs = np.einsum("ij,ijk->jk", weight * more, apart)
    rest = np.arange(len(place)) != held
    moved = mean * (place - place[held])
    moved[rest] += np.linalg.solve(laplacian[np.ix_(rest, rest)], rhs[rest])
    T_w_c[:, :3, 3] = place[held] + moved
    point = np.repeat(np.arange(len(problem.points)), np.diff(problem.starts))
    camera, believed = problem.camera, np.where(result.inlier, 1.0, _REJECTED)
    seen = result.points[point] - place[camera]
    offsets = T_w_c[camera, :3, 3] - place[camera] + (growth[camera, None] - 1.0) * seen
    moves = np.zeros_like(result.points)
    np.add.at(moves, point, believed[:, None] * offsets)
    observed = np.maximum(np.bincount(point, believed, len(moves)), _REJECTED)[:, None]
    T_c_w: F64 = np.linalg.inv(T_w_c).astype(np.float64)
    T_c_w[held] = result.T_c_m[held]
    return replace(result, T_c_m=T_c_w, points=result.points + moves / observed)


def _views(path: MapPath) -> F64:
    """How often the view has changed (k,) up to each node: by moving as far as what is seen, or by turning."""
    a, change = path.begin, np.full(len(path.camera) - 1, _CHAIN_VIEWS)
    turned = np.linalg.norm(_turns(path.R_w_b[a], path.R_w_b[a + 1]), axis=1)
    moved = np.linalg.norm(path.camera[a + 1] - path.camera[a], axis=1)
    change[a] = moved / path.depth_m + turned / _TURN_RAD
    return np.concatenate([[0.0], np.cumsum(change)])


def _turns(R: F64, R_next: F64) -> F64:
    """Sine of the angle and axis (n,3) between rotations (n,3,3): steps turn little."""
    D = np.swapaxes(R, 1, 2) @ R_next
    return 0.5 * np.stack([D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], axis=1)


def _interpolation(at: F64, knots: F64) -> F64:
    """Weights (n,m) of values at knots (m,), linear between them."""
    return np.column_stack([np.interp(at, knots, unit) for unit in np.eye(len(knots))])


def _nodes_of_keyframes(segments: tuple[Segment, ...], path: MapPath) -> tuple[I64, I64, F64]:
    """Keyframes at which segments begin or end, the node of each, and the depth that is seen around it."""
    node: dict[int, tuple[int, float]] = {}
    step = 0
    for s in segments:
        node[s.first] = int(path.begin[step]), s.depth_m
        step += len(s.steps.dt_s)
        node[s.last] = int(path.begin[step - 1]) + 1, s.depth_m
    return (
        np.array(list(node), np.int64), np.array([n for n, _ in node.values()], np.int64),
        np.array([depth for _, depth in node.values()]),
    )  # fmt: skip


def _returns(T_w_c: F64, shared: F64, views: F64, depth_m: F64) -> list[tuple[int, int, float]]:
    """Keyframes (i, j) of a path with landmarks in common though the view changed in between, and by how much i and j
    differ in view: each keyframe with the most similar one."""
    out = []
    for j in range(len(T_w_c)):
        others = np.flatnonzero((shared[j] >= _LEAST_SHARED) & (views < views[j] - _RETURN_VIEWS))
        if len(others) == 0:
            continue
        moved = np.linalg.norm(T_w_c[others, :3, 3] - T_w_c[j, :3, 3], axis=1)
        turned = np.array([np.linalg.norm(se3.so3_log(T_w_c[i, :3, :3].T @ T_w_c[j, :3, :3])) for i in others])
        apart = moved / depth_m[j] + turned / _TURN_RAD
        best = int(np.argmin(apart))
        out.append((int(others[best]), j, max(float(apart[best]), _LEAST_VIEWS)))
    return out


def _tied(shared: F64) -> F64:
    """The landmarks that keyframes share (k,k), and a little for neighbours that share none."""
    k = len(shared)
    beside = np.eye(k, k=1) + np.eye(k, k=-1)
    return np.asarray(shared + _WEAK * beside)


def _spread(values: F64, shared: F64) -> F64:
    """Rows (k,m) with those that are not known taken from the keyframes with which they share landmarks."""
    known = np.isfinite(values).all(axis=1)
    if known.all():
        return values
    weight = _tied(shared)
    laplacian = np.diag(weight.sum(axis=1)) - weight
    out = values.copy()
    out[~known] = np.linalg.solve(laplacian[np.ix_(~known, ~known)], weight[np.ix_(~known, known)] @ values[known])
    return out

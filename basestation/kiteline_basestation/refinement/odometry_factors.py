"""What the agent measured between a keyframe and its parent, for bundles.

The agent saw all frames in between, and felt them where it has an IMU; a thin link carries a tenth of the points that
its tracker saw. So the pose relative to the parent knows what the points of two keyframes do not tell. It enters a
bundle as a few made-up points that both keyframes see just where that pose puts them. Where a keyframe has enough
points of its own, the made-up ones are far away and say only how it turned, which the agent knows best (to 0.1 to 0.2
mrad an axis, from keyframe to keyframe). Disparities that are off spoil the agent's lengths, and its turns a little,
all of them the same way: where that shows, the links are looser.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import OdometryFactorConfig
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.bundle_window import BundleWindow
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId, agent_of_keyframe
from kiteline_core.optimisation.bundle import BundleProblem, BundleResult

F64 = NDArray[np.float64]

_GRID = np.stack(np.meshgrid((-0.6, 0.0, 0.6), (-0.4, 0.4)), -1).reshape(-1, 2)  # x/z, y/z: as wide as a usual lens
_LOOSE = 1.7  # deviations of each of 6 far points, seen twice, that make one of the turn
_LEAST_RUN = 5  # links; fewer tell nothing of what they have in common
_FAR = (8.0,)  # the same where only the turn is to be held
_DEPTHS = (0.7, 1.8)  # times the median depth: near points hold the position, far ones the direction


def with_odometry_factors(sparse_map: SparseMap, window: BundleWindow, config: OdometryFactorConfig) -> BundleProblem:
    """The window's problem with the links between its keyframes, firmer where few points are; made-up points last."""
    problem = window.problem
    table = sparse_map.keyframes
    counts = np.bincount(problem.camera, minlength=len(window.rows))
    number = {int(table.id[row]): i for i, row in enumerate(window.rows.tolist())}
    loose = max(config.rotation_sigma_px, _LOOSE * _turns_differ_px(sparse_map, window, number, config.run))
    points, camera, measured, sigma = [], [], [], []
    for k, row in enumerate(window.rows.tolist()):
        p = number.get(int(table.parent[row]))
        agent = agent_of_keyframe(KeyframeId(int(table.id[row])))
        deep = sparse_map.cameras[agent].stereo or agent in sparse_map.measures_depth
        if p is None or not deep or not (problem.free[k] or problem.free[p]):
            continue
        few = max(0.0, 1.0 - min(counts[k], counts[p]) / config.enough_observations)
        deviation = 1.0 / np.hypot(few / config.sigma_px, 1.0 / loose)
        seen = _made_up(sparse_map, problem, k, p, table.T_p_k[row], _DEPTHS if few > 0.0 else _FAR)
        if seen is None:
            continue
        in_k, in_p, world = seen
        points.append(world)
        first, second = (p, k) if p < k else (k, p)
        for i in range(len(world)):
            camera += [first, second]
            measured += [in_p[i], in_k[i]] if p < k else [in_k[i], in_p[i]]
            sigma += [[deviation, deviation]] * 2
    if not points:
        return problem
    added = np.concatenate(points)
    border = problem.border
    if border is not None:
        none = np.full(len(camera), -1, np.int32)
        terms = np.concatenate([border.terms, np.zeros((len(camera), border.terms.shape[1]))])
        border = replace(border, group=np.concatenate([border.group, none]), terms=terms)
    return replace(
        problem,
        points=np.concatenate([problem.points, added]),
        starts=np.concatenate(
            [problem.starts, problem.starts[-1] + 2 * np.arange(1, len(added) + 1, dtype=np.int32)]
        ).astype(np.int32),
        camera=np.concatenate([problem.camera, np.array(camera, np.int32)]),
        measured=np.concatenate([problem.measured, np.array(measured)]),
        sigma=np.concatenate([problem.sigma, np.array(sigma)]),
        border=border,
    )


def _turns_differ_px(sparse_map: SparseMap, window: BundleWindow, number: dict[int, int], run: int) -> float:
    """By how much the window's turns from keyframe to keyframe differ from what agents said, an axis: the median, or,
    where more, what runs of them differ by together. Disparities that are off turn all keyframes a little the same way.
    """
    table, T = sparse_map.keyframes, window.problem.T_c_m
    parents = [number.get(int(p), -1) for p in table.parent[window.rows].tolist()]
    pairs = [(k, p) for k, p in enumerate(parents) if p >= 0]
    if not pairs:
        return 0.0
    k, p = np.array(pairs).T
    turn = T[p, :3, :3] @ np.swapaxes(T[k, :3, :3], 1, 2)
    off = np.swapaxes(table.T_p_k[window.rows[k], :3, :3], 1, 2) @ turn
    angle = 0.5 * np.stack([off[:, 2, 1] - off[:, 1, 2], off[:, 0, 2] - off[:, 2, 0], off[:, 1, 0] - off[:, 0, 1]], 1)
    each = float(np.median(np.linalg.norm(angle, axis=1)) / np.sqrt(3.0))
    n = min(run, len(angle))
    summed = np.cumsum(np.concatenate([np.zeros((1, 3)), angle]), axis=0)
    together = float(np.sqrt(np.mean((summed[n:] - summed[:-n]) ** 2) / n))
    if n < _LEAST_RUN:
        together = 0.0
    return max(each, together) * float(np.median(window.problem.lens[k, 0]))


def _made_up(
    sparse_map: SparseMap, problem: BundleProblem, k: int, p: int, T_p_k: F64, depths: tuple[float, ...]
) -> tuple[F64, F64, F64] | None:  # fmt: skip
    """What both keyframes measure (n,3) of made-up points, and where these are now (n,3)."""
    own = problem.camera == k
    depth = problem.measured[own, 2]
    depth = depth[depth > 0]
    typical = problem.lens[k, 4] / float(np.median(depth)) if len(depth) else 3.0
    local = np.concatenate([np.column_stack([_GRID, np.ones(len(_GRID))]) * typical * d for d in depths])
    in_parent = se3.transform(T_p_k, local)
    ahead = in_parent[:, 2] > 0.1 * typical
    if np.count_nonzero(ahead) < 4:
        return None
    local, in_parent = local[ahead], in_parent[ahead]
    world = se3.transform(se3.inverse(problem.T_c_m[k]), local)
    return _seen(problem.lens[k], local), _seen(problem.lens[p], in_parent), world


def _seen(lens: F64, xyz: F64) -> F64:
    """u, v, disparity (n,3) px of points in a camera."""
    inv = 1.0 / xyz[:, 2]
    return np.column_stack([lens[0] * xyz[:, 0] * inv + lens[2], lens[1] * xyz[:, 1] * inv + lens[3], lens[4] * inv])


def without_odometry_factors(window: BundleWindow, result: BundleResult) -> BundleResult:
    """The result for the window's own points and observations."""
    return replace(result, points=result.points[: len(window.points)], inlier=result.inlier[: len(window.slots)])

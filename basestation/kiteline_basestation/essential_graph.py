"""The essential graph: keyframes held together by their spanning tree, by strong covisibility and by loops.

Source: H. Strasdat et al., "Double window optimisation for constant time visual SLAM", and the essential graph of
ORB-SLAM2; solved by Gauss-Newton in gtsam. Loops count less the more they contradict the rest (Huber).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import GraphConfig

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class GraphInputs:
    """A pose graph. keyframes: (n,) ids. T_w_k: (n,4,4) the start. held: (n,) which do not move.

    edges: (m,2) rows a, b. T_a_b: (m,4,4). sigma: (m,2) m and rad. loop: (m,) which may be wrong.
    """

    keyframes: I64
    T_w_k: F64
    held: Bools
    edges: I64
    T_a_b: F64
    sigma: F64
    loop: Bools
    config: GraphConfig


@dataclass(frozen=True, slots=True)
class GraphResult:
    """T_w_k: (n,4,4). residual: (m,) deviations by which each edge is off. cost_ops: arithmetic operations."""

    keyframes: I64
    T_w_k: F64
    residual: F64
    cost_ops: int


def optimise(inputs: GraphInputs) -> GraphResult:
    """Where the keyframes lie when all edges are heard."""
    import gtsam  # heavy, and needed only here

    noises: dict[tuple[float, ...], gtsam.noiseModel.Base] = {}
    for row in np.unique(np.column_stack([inputs.sigma, inputs.loop]), axis=0):
        sigmas = np.array([row[1]] * 3 + [row[0]] * 3)  # gtsam has rotation first
        noise: gtsam.noiseModel.Base = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        if row[2]:
            huber = gtsam.noiseModel.mEstimator.Huber.Create(inputs.config.huber)
            noise = gtsam.noiseModel.Robust.Create(huber, noise)
        noises[tuple(row.tolist())] = noise
    start = gtsam.Values()
    for i, pose in enumerate(inputs.T_w_k):
        start.insert(i, gtsam.Pose3(pose))
    graph = gtsam.NonlinearFactorGraph()
    firm = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    for i in np.flatnonzero(inputs.held).tolist():
        graph.add(gtsam.PriorFactorPose3(i, gtsam.Pose3(inputs.T_w_k[i]), firm))
    keys = np.column_stack([inputs.sigma, inputs.loop]).tolist()
    for (a, b), T, key in zip(inputs.edges.tolist(), inputs.T_a_b, keys):
        graph.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T), noises[tuple(key)]))
    params = gtsam.GaussNewtonParams()
    params.setMaxIterations(inputs.config.iterations)
    params.setRelativeErrorTol(inputs.config.stop)
    optimiser = gtsam.GaussNewtonOptimizer(graph, start, params)
    values = optimiser.optimize()
    poses = np.stack([values.atPose3(i).matrix() for i in range(len(inputs.T_w_k))])
    if not np.isfinite(poses).all():
        poses = inputs.T_w_k.copy()
    poses[inputs.held] = inputs.T_w_k[inputs.held]
    work = int(optimiser.iterations()) * (8_000 * len(inputs.edges) + 6_000 * len(poses))
    return GraphResult(
        inputs.keyframes, poses, residuals(inputs, poses), 300_000 + 6_000 * len(inputs.edges) + work // 4
    )


def residuals(inputs: GraphInputs, T_w_k: F64) -> F64:
    """By how many deviations (m,) each edge is off."""
    if len(inputs.edges) == 0:
        return np.empty(0)
    T_a_b = _inverses(T_w_k[inputs.edges[:, 0]]) @ T_w_k[inputs.edges[:, 1]]
    error = _inverses(inputs.T_a_b) @ T_a_b
    shift = np.linalg.norm(error[:, :3, 3], axis=1) / inputs.sigma[:, 0]
    chord = np.linalg.norm(error[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)
    turn = 2.0 * np.arcsin(np.minimum(chord, 1.0)) / inputs.sigma[:, 1]
    return np.asarray(np.hypot(shift, turn))


def _inverses(poses: F64) -> F64:
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], poses[:, :3, 3])
    return out

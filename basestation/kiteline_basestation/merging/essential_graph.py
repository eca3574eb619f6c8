"""Pose graph optimisation over the essential graph: spanning tree, strong covisibility and loop edges.

Where level is known, roll and pitch stay, and four degrees of freedom are left: T. Qin et al., "VINS-Mono", 2018.

Source: H. Strasdat et al., "Double window optimisation for constant time visual SLAM", and the essential graph of
ORB-SLAM2; solved by Gauss-Newton in gtsam, with a Huber kernel on loop edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kiteline_basestation.config import GraphConfig
from kiteline_basestation.inertial.level import Level
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry import se3

if TYPE_CHECKING:
    import gtsam


_ITERATIONS = 8  # of Gauss-Newton
_SCALE_ITERATIONS = 30  # of Levenberg-Marquardt, with scales: these graphs bend farther
_FREE = 1e3  # rad, and units of lengths: a deviation that holds nothing
_LEVEL_INFLATION = 4.5  # of deviations of gravity, whose errors are the same over some 20 keyframes


@dataclass(frozen=True, slots=True)
class GraphInputs:
    """A pose graph. keyframes: (n,) ids. T_w_k: (n,4,4) initial poses. held: (n,) True for fixed keyframes.

    edges: (m,2) rows a, b. T_a_b: (m,4,4). sigma: (m,2) m and rad. loop: (m,) True for loop edges. scaled: None unless
    scale may drift. level: keyframes that keep roll and pitch, as far as their agents know gravity.
    """

    keyframes: I64
    T_w_k: F64
    held: Bool
    edges: I64
    T_a_b: F64
    sigma: F64
    loop: Bool
    config: GraphConfig
    scaled: Scaled | None = None
    level: Level | None = None


@dataclass(frozen=True, slots=True)
class Scaled:
    """Scales of a graph over similarities. free: (n,) keyframes of monocular submaps, whose scale is unknown.

    scale: (m,) of each edge, the factor on lengths near b over that near a. sigma: (m,) of its logarithm.
    """

    free: Bool
    scale: F64
    sigma: F64


@dataclass(frozen=True, slots=True)
class GraphResult:
    """T_w_k: (n,4,4). scale: (n,) factors on lengths near each keyframe. residual: (m,) of each edge, in standard
    deviations. cost_ops: arithmetic operations.
    """

    keyframes: I64
    T_w_k: F64
    scale: F64
    residual: F64
    cost_ops: int


def optimise(inputs: GraphInputs) -> GraphResult:
    """Optimise the poses, and the scales where they may drift."""
    return _with_scale(inputs, inputs.scaled) if inputs.scaled is not None else _rigid(inputs)


def _rigid(inputs: GraphInputs) -> GraphResult:
    import gtsam  # heavy, and needed only here

    start = gtsam.Values()
    for i, pose in enumerate(inputs.T_w_k):
        start.insert(i, gtsam.Pose3(pose))
    graph = gtsam.NonlinearFactorGraph()
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    for i in np.flatnonzero(inputs.held).tolist():
        graph.add(gtsam.PriorFactorPose3(i, gtsam.Pose3(inputs.T_w_k[i]), fixed))
    noises = _edge_noises(inputs.sigma[:, [1, 1, 1, 0, 0, 0]], inputs)
    for (a, b), T, noise in zip(inputs.edges.tolist(), inputs.T_a_b, noises):
        graph.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T), noise))
    if inputs.level is not None:
        up_w = gtsam.Unit3(inputs.level.up_w)
        for i, sigma in zip(inputs.level.rows.tolist(), inputs.level.sigma.tolist()):
            kept = gtsam.Unit3(inputs.T_w_k[i, :3, :3].T @ inputs.level.up_w)
            known: gtsam.noiseModel.Base = gtsam.noiseModel.Isotropic.Sigma(2, _LEVEL_INFLATION * sigma)
            graph.add(gtsam.AttitudeFactorPose3(i, up_w, known, kept))
    params = gtsam.GaussNewtonParams()
    params.setMaxIterations(_ITERATIONS)
    params.setRelativeErrorTol(inputs.config.stop)
    optimiser = gtsam.GaussNewtonOptimizer(graph, start, params)
    values = optimiser.optimize()
    poses = np.stack([values.atPose3(i).matrix() for i in range(len(inputs.T_w_k))])
    if not np.isfinite(poses).all():
        poses = inputs.T_w_k.copy()
    poses[inputs.held] = inputs.T_w_k[inputs.held]
    work = int(optimiser.iterations()) * (8_000 * len(inputs.edges) + 6_000 * len(poses))
    return GraphResult(
        inputs.keyframes, poses, np.ones(len(poses)), residuals(inputs, poses),
        300_000 + 6_000 * len(inputs.edges) + work // 4,
    )  # fmt: skip


def _with_scale(inputs: GraphInputs, scaled: Scaled) -> GraphResult:
    """Over similarities (H. Strasdat et al., "Scale drift-aware large scale monocular SLAM", 2010)."""
    import gtsam

    config = inputs.config
    start = gtsam.Values()
    graph = gtsam.NonlinearFactorGraph()
    fixed = gtsam.noiseModel.Isotropic.Sigma(7, 1e-6)
    unit_scale = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e6] * 6 + [1e-6]))
    for i, pose in enumerate(inputs.T_w_k):
        S_w_k = _similarity(pose, 1.0)
        start.insert(i, S_w_k)
        if inputs.held[i] or not scaled.free[i]:
            graph.add(gtsam.PriorFactorSimilarity3(i, S_w_k, fixed if inputs.held[i] else unit_scale))
    noises = _edge_noises(np.column_stack([inputs.sigma[:, [1, 1, 1, 0, 0, 0]], scaled.sigma]), inputs)
    for (a, b), T, scale, noise in zip(inputs.edges.tolist(), inputs.T_a_b, scaled.scale.tolist(), noises):
        graph.add(gtsam.BetweenFactorSimilarity3(a, b, _similarity(T, scale), noise))
    if inputs.level is not None:
        for i, sigma in zip(inputs.level.rows.tolist(), inputs.level.sigma.tolist()):
            pose = inputs.T_w_k[i]
            tilt = _tilt_noise(pose[:3, :3].T @ inputs.level.up_w, _LEVEL_INFLATION * sigma)
            graph.add(gtsam.PriorFactorSimilarity3(i, _similarity(pose, 1.0), tilt))
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(_SCALE_ITERATIONS)
    params.setRelativeErrorTol(config.stop)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, params)
    values = optimiser.optimize()
    found = [values.atSimilarity3(i) for i in range(len(inputs.T_w_k))]
    scale = np.array([S.scale() for S in found])
    poses = np.stack([se3.from_rt(S.rotation().matrix(), S.scale() * S.translation()) for S in found])
    if not (np.isfinite(poses).all() and np.isfinite(scale).all() and (scale > 0.0).all()):
        poses, scale = inputs.T_w_k.copy(), np.ones(len(poses))
    poses[inputs.held], scale[inputs.held] = inputs.T_w_k[inputs.held], 1.0
    scale[~scaled.free] = 1.0
    work = int(optimiser.iterations()) * (12_000 * len(inputs.edges) + 9_000 * len(poses))
    residual = residuals(inputs, poses, scale)
    return GraphResult(inputs.keyframes, poses, scale, residual, 300_000 + 9_000 * len(inputs.edges) + work // 4)


def _edge_noises(sigmas: F64, inputs: GraphInputs) -> list[gtsam.noiseModel.Base]:
    """Noise of each edge by its deviations (m,6 or 7) in the order of gtsam: rotation, translation, scale.

    Loop edges get a Huber kernel. Equal edges share one object.
    """
    import gtsam

    huber = gtsam.noiseModel.mEstimator.Huber.Create(inputs.config.huber)
    noises: dict[tuple[float, ...], gtsam.noiseModel.Base] = {}
    of_edges = []
    for row, loop in zip(map(tuple, sigmas.tolist()), inputs.loop.tolist()):
        if (*row, loop) not in noises:
            noise: gtsam.noiseModel.Base = gtsam.noiseModel.Diagonal.Sigmas(np.array(row))
            noises[(*row, loop)] = gtsam.noiseModel.Robust.Create(huber, noise) if loop else noise
        of_edges.append(noises[(*row, loop)])
    return of_edges


def _tilt_noise(up_k: F64, sigma: float) -> gtsam.noiseModel.Base:
    """Noise of a known direction of gravity up_k (3,) in a keyframe: all but the turns across it are free."""
    import gtsam

    covariance = np.diag([_FREE**2] * 7)
    covariance[:3, :3] = sigma**2 * np.eye(3) + (_FREE**2 - sigma**2) * np.outer(up_k, up_k)
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def _similarity(T: F64, scale: float) -> gtsam.Similarity3:
    """The similarity of gtsam, which maps p to scale (R p + t)."""
    import gtsam

    return gtsam.Similarity3(gtsam.Rot3(T[:3, :3]), T[:3, 3] / scale, scale)


def residuals(inputs: GraphInputs, T_w_k: F64, scale: F64 | None = None) -> F64:
    """Residuals (m,) of the edges in standard deviations. scale: (n,) factors on lengths near the keyframes."""
    if len(inputs.edges) == 0:
        return np.empty(0)
    T_a_b = _inverses(T_w_k[inputs.edges[:, 0]]) @ T_w_k[inputs.edges[:, 1]]
    if scale is not None and inputs.scaled is not None:
        T_a_b[:, :3, 3] /= scale[inputs.edges[:, 0], None]
        ratio = scale[inputs.edges[:, 1]] / scale[inputs.edges[:, 0]]
        scale_error = np.log(ratio / inputs.scaled.scale) / inputs.scaled.sigma
    else:
        scale_error = np.zeros(len(T_a_b))
    error = _inverses(inputs.T_a_b) @ T_a_b
    shift = np.linalg.norm(error[:, :3, 3], axis=1) / inputs.sigma[:, 0]
    chord = np.linalg.norm(error[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)
    rotation = 2.0 * np.arcsin(np.minimum(chord, 1.0)) / inputs.sigma[:, 1]
    return np.asarray(np.sqrt(shift**2 + rotation**2 + scale_error**2))


def _inverses(poses: F64) -> F64:
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], poses[:, :3, 3])
    return out

"""Absolute pose from matches: of a camera before known points, and of two cameras that both know the points' depths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_core.geometry import se3
from kiteline_core.pose import pnp_kernels as kernels
from kiteline_core.pose import similarity_kernels
from kiteline_core.pose.pose_kernels import optimise_pose

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RansacConfig:
    """How long to draw, and what supports a pose."""

    draws: int = 300  # at most; finds a triple without outliers among 25 % inliers with 99 %
    confidence: float = 0.99  # that one of the draws so far was free of outliers: then they end
    limit_px: float = 3.0  # error of an inlier at octave 0: three deviations of a corner's place
    chi2: float = 9.21  # of the refinement: 99 % of a chi-square with 2 degrees of freedom
    sigma_px: float = 1.0  # deviation of a detected corner at octave 0


@dataclass(frozen=True, slots=True)
class PoseFit:
    """T_c_m: (4,4). inlier: (n,). inliers: how many."""

    T_c_m: F64
    inlier: Bools
    inliers: int


@dataclass(frozen=True, slots=True)
class Alignment:
    """S_a_b: (4,4) similarity, `scale` times a rotation in its upper left. inlier: (n,). inliers: how many."""

    S_a_b: F64
    scale: float
    inlier: Bools
    inliers: int


def solve_pnp(
    points: F64, depth_ray: F64, observed: F64, octave: NDArray[np.uint8], camera: F64, seed: int,
    config: RansacConfig | None = None,
) -> PoseFit | None:  # fmt: skip
    """Pose of a camera by P3P in RANSAC, then robust optimisation. None when nothing supports one.

    points: (n,3) m. depth_ray: (n,3) m, one deviation of each along its ray. observed: (n,3) u, v, disparity px (< 0:
    none). octave: (n,). camera: (5,) fx, fy, cx, cy, bf. seed: any number; the same one draws the same triples.
    """
    config = config or RansacConfig()
    n = len(points)
    if n < 4:
        return None
    scale = np.ldexp(1.0, octave.astype(np.int32))
    T, inlier = np.eye(4), np.zeros(n, np.bool_)
    uv = np.ascontiguousarray(observed[:, :2])
    count = kernels.p3p_ransac(
        points, uv, config.limit_px * scale, camera, config.draws, config.confidence, _state(seed), T, inlier
    )
    if count < 4:
        return None
    inliers, _ = optimise_pose(
        T, points, depth_ray, observed, config.sigma_px * scale, camera, T.copy(), np.zeros(6), 3, 4, config.chi2,
        inlier, np.zeros((6, 6)),
    )  # fmt: skip
    if not np.isfinite(T).all():
        return None
    return PoseFit(se3.orthonormalise(T), inlier, int(inliers))


def align_points(a: F64, b: F64, with_scale: bool = False) -> F64 | None:
    """Least-squares S_a_b (4,4) with a = S_a_b b of points (n,3) (B. Horn, 1987). None when they leave it open."""
    S = np.eye(4)
    if not similarity_kernels.align_points(a, b, np.ones(len(a), np.bool_), with_scale, S):
        return None
    return S


def align_views(
    a: F64, uv_a: F64, octave_a: NDArray[np.uint8], camera_a: F64,
    b: F64, uv_b: F64, octave_b: NDArray[np.uint8], camera_b: F64,
    with_scale: bool, seed: int, config: RansacConfig | None = None,
) -> Alignment | None:  # fmt: skip
    """How two cameras lie that see the same points: three-point alignment in RANSAC, support counted in both images.

    a, b: (n,3) m of each pair in either camera. uv: (n,2) px there. octave: (n,). camera: fx, fy, cx, cy first.
    with_scale: False holds the scale at 1 (stereo, RGB-D). None when nothing supports one.
    """
    config = config or RansacConfig()
    if len(a) < 4:
        return None
    S, inlier = np.eye(4), np.zeros(len(a), np.bool_)
    limit_a = config.limit_px * np.ldexp(1.0, octave_a.astype(np.int32))
    limit_b = config.limit_px * np.ldexp(1.0, octave_b.astype(np.int32))
    count = similarity_kernels.align_ransac(
        a, uv_a, limit_a, camera_a, b, uv_b, limit_b, camera_b, with_scale, config.draws, config.confidence,
        _state(seed), S, inlier,
    )  # fmt: skip
    if count < 4:
        return None
    return Alignment(S, float(np.cbrt(np.linalg.det(S[:3, :3]))), inlier, int(count))


def _state(seed: int) -> NDArray[np.uint64]:
    """A generator's state from any seed: SplitMix64's finaliser, so that neighbours draw unlike numbers."""
    x = (seed + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
    return np.array([(x ^ (x >> 31)) or 1], np.uint64)

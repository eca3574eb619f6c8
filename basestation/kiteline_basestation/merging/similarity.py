"""Similarity transform between two sets of points, or between two cameras that observe the same points."""

from dataclasses import dataclass

import numpy as np

from kiteline_basestation.merging import similarity_kernels
from kiteline_core.arrays import F64, U8, Bool
from kiteline_core.pose.pnp import RANSAC_CONFIDENCE, RANSAC_DRAWS, RANSAC_LIMIT_PX, generator_state


@dataclass(frozen=True, slots=True)
class SimilarityFit:
    """S_a_b: (4,4) similarity, `scale` times a rotation in its upper left. inlier: (n,). inliers: their number."""

    S_a_b: F64
    scale: float
    inlier: Bool
    inliers: int


def align_points(a: F64, b: F64, with_scale: bool = False) -> F64 | None:
    """Least-squares S_a_b (4,4) with a = S_a_b b of points (n,3) (B. Horn, 1987); None if degenerate."""
    S = np.eye(4)
    if not similarity_kernels.align_points(a, b, np.ones(len(a), np.bool_), with_scale, S):
        return None
    return S


def align_views(
    a: F64, uv_a: F64, octave_a: U8, camera_a: F64,
    b: F64, uv_b: F64, octave_b: U8, camera_b: F64,
    *, with_scale: bool, seed: int,
) -> SimilarityFit | None:  # fmt: skip
    """Similarity between two cameras from common points: three-point RANSAC, with inliers counted in both images.

    a, b: (n,3) m of each pair in either camera. uv: (n,2) px. octave: (n,). camera: fx, fy, cx, cy first. with_scale:
    False fixes the scale at 1 (stereo, RGB-D). None without enough inliers.
    """
    if len(a) < 4:
        return None
    S, inlier = np.eye(4), np.zeros(len(a), np.bool_)
    limit_a = RANSAC_LIMIT_PX * np.ldexp(1.0, octave_a.astype(np.int32))
    limit_b = RANSAC_LIMIT_PX * np.ldexp(1.0, octave_b.astype(np.int32))
    count = similarity_kernels.align_ransac(
        a, uv_a, limit_a, camera_a, b, uv_b, limit_b, camera_b, with_scale, RANSAC_DRAWS, RANSAC_CONFIDENCE,
        generator_state(seed), S, inlier,
    )  # fmt: skip
    if count < 4:
        return None
    return SimilarityFit(S, float(np.cbrt(np.linalg.det(S[:3, :3]))), inlier, int(count))

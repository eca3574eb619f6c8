"""Camera pose from matches between points and pixels: P3P in RANSAC, then robust optimisation."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64, U8, U64, Bool
from kiteline_core.geometry import se3
from kiteline_core.pose import pnp_kernels as kernels
from kiteline_core.pose.pose_kernels import optimise_pose

RANSAC_CONFIDENCE = 0.99  # that one of the draws was free of outliers: then drawing ends
RANSAC_LIMIT_PX = 3.0  # px; error of an inlier at octave 0: three deviations of a corner's place
RANSAC_DRAWS = 300  # at most; finds a triple without outliers among 25 % inliers with 99 %
PIXEL_CHI2 = 9.21  # of the refinement: 99 % of a chi-square with 2 degrees of freedom
CORNER_SIGMA_PX = 1.0  # px; deviation of a detected corner at octave 0


@dataclass(frozen=True, slots=True)
class PoseFit:
    """T_c_m: (4,4). inlier: (n,). inliers: their number."""

    T_c_m: F64
    inlier: Bool
    inliers: int


def solve_pnp(points: F64, depth_ray: F64, observed: F64, octave: U8, camera: F64, seed: int) -> PoseFit | None:
    """Camera pose by P3P in RANSAC, then robust optimisation; None without enough inliers.

    points: (n,3) m. depth_ray: (n,3) m, one standard deviation along the ray. observed: (n,3) u, v, disparity px
    (< 0: none). octave: (n,). camera: (5,) fx, fy, cx, cy, bf. seed: determines the draws.
    """
    n = len(points)
    if n < 4:
        return None
    scale = np.ldexp(1.0, octave.astype(np.int32))
    T, inlier = np.eye(4), np.zeros(n, np.bool_)
    uv = np.ascontiguousarray(observed[:, :2])
    count = kernels.p3p_ransac(
        points, uv, RANSAC_LIMIT_PX * scale, camera, RANSAC_DRAWS, RANSAC_CONFIDENCE, generator_state(seed), T, inlier
    )
    if count < 4:
        return None
    inliers, _ = optimise_pose(
        T, points, depth_ray, observed, CORNER_SIGMA_PX * scale, camera, 3, 4, PIXEL_CHI2, inlier
    )
    if not np.isfinite(T).all():
        return None
    return PoseFit(se3.orthonormalise(T), inlier, int(inliers))


def generator_state(seed: int) -> U64:
    """State (1,) of the generator in ransac_kernels: SplitMix64's finaliser, so that close seeds differ."""
    x = (seed + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
    return np.array([(x ^ (x >> 31)) or 1], np.uint64)

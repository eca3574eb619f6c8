"""Bundle adjustment: keyframe poses and points that agree best with robust pixel and disparity residuals.

Source: B. Triggs et al., "Bundle adjustment, a modern synthesis", 2000, section 6 (Schur complement); the two rounds
with an outlier test between them are those of ORB-SLAM2 and of "DS-PTAM: a distributed stereo PTAM".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_core import bundle_kernels as kernels
from kiteline_core.robust import CHI2_2, CHI2_2_MEDIAN, CHI2_3, CHI2_3_MEDIAN

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class BundleConfig:
    """How a bundle is minimised."""

    robust_trials: int = 5  # Levenberg-Marquardt trials before the outlier test
    final_trials: int = 5  # trials after it
    stop: float = 1e-4  # relative gain in cost below which more trials change nothing that can be seen
    chi2_mono: float = CHI2_2  # squared normalised residual of a pixel at the knee of Huber's cost: 95 %
    chi2_stereo: float = CHI2_3  # the same of a pixel with disparity
    outlier: float = 1.0  # an outlier lies this many times beyond the knee


@dataclass(frozen=True, slots=True)
class BundleProblem:
    """What is to be adjusted. Arrays are taken as they are and never changed.

    T_c_m: (k,4,4) poses of the cameras. lens: (k,5) fx fy cx cy bf. free: (k,) whether a pose may move. points: (n,3)
    in m. starts: (n + 1,) int32 rows of each point's observations. camera: (m,) int32, increasing inside a point.
    measured: (m,3) u, v, disparity in px, disparity -1 where there is none. sigma: (m,2) px of pixel and disparity.
    """

    T_c_m: F64
    lens: F64
    free: Bool
    points: F64
    starts: I32
    camera: I32
    measured: F64
    sigma: F64


@dataclass(frozen=True, slots=True)
class BundleResult:
    """What came out. inlier: (m,) whether an observation passed the outlier test. cost_ops: arithmetic operations."""

    T_c_m: F64
    points: F64
    inlier: Bool
    initial_cost: float
    final_cost: float
    trials: int
    cost_ops: int


def bundle(problem: BundleProblem, config: BundleConfig) -> BundleResult:
    """Minimise the sum of Huber costs, drop outliers, minimise again without them.

    Where the camera measures worse than `sigma` says, the outlier bound grows with the spread that is found.
    """
    cameras = pack(problem.T_c_m)
    points = problem.points.astype(np.float64, copy=True)
    free = np.full(len(cameras), -1, np.int32)
    free[problem.free] = np.arange(np.count_nonzero(problem.free), dtype=np.int32)
    weight = 1.0 / np.square(problem.sigma)
    n, m, f = len(points), len(problem.camera), int(np.count_nonzero(problem.free))
    bound = np.array([config.chi2_mono, config.chi2_stereo])
    squared = np.empty(m)
    scratch = (
        np.empty((f, 6, 6)), np.empty((f, 6)), np.empty((n, 6)), np.empty((n, 3)), np.empty((m, 6, 3)),
        np.empty((n, 6)), np.empty((6 * f, 6 * f)), np.empty(6 * f), np.empty_like(cameras), np.empty_like(points),
    )  # fmt: skip
    counts = np.zeros(3, np.int64)
    model = (problem.starts, problem.camera, problem.measured, weight)
    kernels.squared_residuals(cameras, problem.lens, points, *model, squared)
    active = (squared < kernels.BEHIND).astype(np.uint8)
    initial = float(kernels.robust_cost(cameras, problem.lens, points, *model, active, bound))
    cost = initial
    limit = np.where(problem.measured[:, 2] >= 0, config.chi2_stereo, config.chi2_mono)
    typical = np.where(problem.measured[:, 2] >= 0, CHI2_3_MEDIAN, CHI2_2_MEDIAN)
    for trials in (config.robust_trials, config.final_trials):
        if trials == 0:
            continue
        cost = float(
            kernels.minimise(
                cameras, problem.lens, points, *model, active, bound, free, trials, config.stop, *scratch, counts
            )
        )
        kernels.squared_residuals(cameras, problem.lens, points, *model, squared)
        scale = float(np.median(squared[active != 0] / typical[active != 0])) if active.any() else 1.0
        active[:] = squared <= config.outlier * limit * max(scale, 1.0)
    return BundleResult(unpack(cameras), points, active != 0, initial, cost, int(counts[0]), _operations(counts, m, f))


def pack(poses: F64) -> F64:
    """Rotations row by row and translations (k,12) of poses (k,4,4)."""
    return np.concatenate([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]], axis=1).astype(np.float64)


def unpack(cameras: F64) -> F64:
    """The inverse of `pack`; rotations are brought back onto the manifold."""
    out = np.zeros((len(cameras), 4, 4))
    u, _, vt = np.linalg.svd(cameras[:, :9].reshape(-1, 3, 3))
    out[:, :3, :3] = u @ vt
    out[:, :3, 3] = cameras[:, 9:]
    out[:, 3, 3] = 1.0
    return out


def _operations(counts: NDArray[np.int64], observations: int, free: int) -> int:
    """The cost model of lock-step flights: one operation is what a core does in a nanosecond, as timed on this code.

    An observation costs 55 to linearise and 40 to weigh, a pair of observations 27; cameras are taken for a band of 20.
    """
    trials, linearisations, pairs = (int(c) for c in counts)
    solving = 6 * free * (6 * min(free, 20)) ** 2 // 10
    return 300_000 + linearisations * observations * 55 + trials * (observations * 40 + solving) + pairs * 27

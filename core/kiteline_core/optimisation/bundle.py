"""Bundle adjustment: keyframe poses and points that agree best with robust pixel and disparity residuals.

Source: B. Triggs et al., "Bundle adjustment, a modern synthesis", 2000, section 6 (Schur complement); the two rounds
with an outlier test between them are those of ORB-SLAM2 and of "DS-PTAM: a distributed stereo PTAM".
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kiteline_core.optimisation import bundle_border_kernels as border_kernels
from kiteline_core.optimisation import bundle_kernels as kernels
from kiteline_core.optimisation.robust import CHI2_2, CHI2_2_MEDIAN, CHI2_3, CHI2_3_MEDIAN

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
class Border:
    """Offsets of disparities that are to be found along with all else.

    group: (m,) int32 whose offset an observation has, -1 none. terms: (m,t): the offset is terms @ c[group], to be
    taken off the disparity. start: (g,t) px of c. sigma: (t,) px, one deviation of c about 0.
    """

    group: I32
    terms: F64
    start: F64
    sigma: F64


@dataclass(frozen=True, slots=True)
class BundleProblem:
    """What is to be adjusted. Arrays are taken as they are and never changed.

    T_c_m: (k,4,4) poses of the cameras. lens: (k,5) fx fy cx cy bf. free: (k,) whether a pose may move. points: (n,3)
    in m. starts: (n + 1,) int32 rows of each point's observations. camera: (m,) int32, increasing inside a point.
    measured: (m,3) u, v, disparity in px, disparity -1 where there is none; with a border, before offsets are taken
    off. sigma: (m,2) px of pixel and disparity.
    """

    T_c_m: F64
    lens: F64
    free: Bool
    points: F64
    starts: I32
    camera: I32
    measured: F64
    sigma: F64
    border: Border | None = None


@dataclass(frozen=True, slots=True)
class BundleResult:
    """What came out. inlier: (m,) whether an observation passed the outlier test. cost_ops: arithmetic operations.

    offset: (g,t) px of the border, offset_cov: (g*t,g*t), empty without one.
    """

    T_c_m: F64
    points: F64
    inlier: Bool
    initial_cost: float
    final_cost: float
    trials: int
    cost_ops: int
    offset: F64 = field(default_factory=lambda: np.empty((0, 0)))
    offset_cov: F64 = field(default_factory=lambda: np.empty((0, 0)))


def bundle(problem: BundleProblem, config: BundleConfig) -> BundleResult:
    """Minimise the sum of Huber costs, drop outliers, minimise again without them.

    Where the camera measures worse than `sigma` says, the outlier bound grows with the spread that is found.
    """
    cameras = pack(problem.T_c_m)
    points = problem.points.astype(np.float64, copy=True)
    free = np.full(len(cameras), -1, np.int32)
    free[problem.free] = np.arange(np.count_nonzero(problem.free), dtype=np.int32)
    weight = 1.0 / np.square(problem.sigma)
    m, f = len(problem.camera), int(np.count_nonzero(problem.free))
    bound = np.array([config.chi2_mono, config.chi2_stereo])
    squared = np.empty(m)
    counts = np.zeros(3, np.int64)
    if problem.border is None:
        work: _Work | _BorderedWork = _Work(problem, cameras, points, weight, bound, free, counts)
    else:
        work = _BorderedWork(problem, problem.border, cameras, points, weight, bound, free, counts)
    model = (problem.starts, problem.camera, work.measured, weight)
    kernels.squared_residuals(cameras, problem.lens, points, *model, squared)
    active = (squared < kernels.BEHIND).astype(np.uint8)
    initial = float(kernels.robust_cost(cameras, problem.lens, points, *model, active, bound))
    cost = initial
    limit = np.where(problem.measured[:, 2] >= 0, config.chi2_stereo, config.chi2_mono)
    typical = np.where(problem.measured[:, 2] >= 0, CHI2_3_MEDIAN, CHI2_2_MEDIAN)
    for trials in (config.robust_trials, config.final_trials):
        if trials == 0:
            continue
        cost = work.minimise(active, trials, config.stop)
        kernels.squared_residuals(cameras, problem.lens, points, *model, squared)
        scale = float(np.median(squared[active != 0] / typical[active != 0])) if active.any() else 1.0
        active[:] = squared <= config.outlier * limit * max(scale, 1.0)
    offset, cov = work.border(active)
    return BundleResult(
        unpack(cameras), points, active != 0, initial, cost, int(counts[0]), _operations(counts, m, f), offset, cov
    )


class _Work:
    """Levenberg-Marquardt in place of cameras and points."""

    def __init__(
        self, problem: BundleProblem, cameras: F64, points: F64, weight: F64, bound: F64, free: I32,
        counts: NDArray[np.int64], more: int = 0,
    ) -> None:  # fmt: skip
        """more: unknowns besides those of cameras and points."""
        n, m, f = len(points), len(problem.camera), int(np.count_nonzero(problem.free))
        self.measured = problem.measured
        self.counts = counts
        self.given = (cameras, problem.lens, points, problem.starts, problem.camera)
        self.weight, self.bound, self.free = weight, bound, free
        self.scratch = (
            np.empty((f, 6, 6)), np.empty((f, 6)), np.empty((n, 6)), np.empty((n, 3)), np.empty((m, 6, 3)),
            np.empty((n, 6)), np.empty((6 * f + more, 6 * f + more)), np.empty(6 * f + more),
            np.empty_like(cameras), np.empty_like(points),
        )  # fmt: skip

    def minimise(self, active: U8, trials: int, stop: float) -> float:
        """So many trials at most; returns the cost."""
        return float(
            kernels.minimise(
                *self.given, self.measured, self.weight, active, self.bound, self.free, trials, stop, *self.scratch,
                self.counts,
            )
        )  # fmt: skip

    def border(self, active: U8) -> tuple[F64, F64]:
        """Nothing."""
        return np.empty((0, 0)), np.empty((0, 0))


class _BorderedWork(_Work):
    """The same with a border: its loop is that of `bundle_kernels.minimise`."""

    def __init__(
        self, problem: BundleProblem, border: Border, cameras: F64, points: F64, weight: F64, bound: F64, free: I32,
        counts: NDArray[np.int64],
    ) -> None:  # fmt: skip
        super().__init__(problem, cameras, points, weight, bound, free, counts, border.start.size)
        b, f = border.start.size, int(np.count_nonzero(problem.free))
        self._raw, self._border, self._c = problem.measured, border, border.start.astype(np.float64, copy=True)
        self._known = 1.0 / np.square(np.tile(border.sigma, len(border.start)))
        self._blocks = (np.empty((b, b)), np.empty(b), np.empty((b, 6 * f)), np.empty((len(problem.camera), 3)))
        self._points_rhs = np.empty_like(points)
        self.measured = problem.measured.copy()
        self._correct(self._c)

    def _correct(self, c: F64) -> None:
        border_kernels.correct(self._raw, self._border.group, self._border.terms, c, self.measured)

    def _prior(self, c: F64) -> float:
        return float(np.sum(self._known * np.square(c.ravel())))

    def _linearise(self, active: U8) -> float:
        given = (*self.given, self.measured, self.weight, active, self.bound)
        cost = kernels.linearise(*given, self.free, *self.scratch[:5])
        border_kernels.accumulate(*given, self.free, self._border.group, self._border.terms, *self._blocks)
        self._blocks[0][np.diag_indices(len(self._known))] += self._known
        self._blocks[1][:] -= self._known * self._c.ravel()
        return float(cost) + self._prior(self._c)

    def _solve(self, active: U8, damping: float) -> bool:
        hcc, bc, hpp, bp, hcp, inv, s, rhs = self.scratch[:8]
        starts, camera = self.given[3:]
        self.counts[2] += kernels.reduce(
            starts, camera, active, self.free, damping, hcc, bc, hpp, bp, hcp, inv, s, rhs
        )  # fmt: skip
        hbb, bb, hbc, hp = self._blocks
        border_kernels.reduce_border(
            starts, camera, active, self.free, damping, hbb, bb, hbc, hp, bp, hcp, inv, self._border.group,
            self._border.terms, s, rhs,
        )  # fmt: skip
        return bool(kernels.solve(s, rhs))

    def minimise(self, active: U8, trials: int, stop: float) -> float:
        """So many trials at most; returns the cost."""
        cameras, lens, points, starts, camera = self.given
        _, _, _, bp, hcp, inv, _, rhs, new_cameras, new_points = self.scratch
        damping, growth, fresh, cost = 1e-4, 2.0, True, 0.0
        cameras_6f = rhs.size - self._c.size
        for _ in range(trials):
            self.counts[0] += 1
            if fresh:
                cost = self._linearise(active)
                self.counts[1] += 1
            fresh = False
            if self._solve(active, damping):
                c = self._c + rhs[cameras_6f:].reshape(self._c.shape)
                border_kernels.points_for(
                    starts, active, self._border.group, self._border.terms, self._blocks[3], bp, rhs[cameras_6f:],
                    self._points_rhs,
                )  # fmt: skip
                kernels.step(
                    cameras, points, starts, camera, active, self.free, inv, self._points_rhs, hcp, rhs, new_cameras,
                    new_points,
                )  # fmt: skip
                self._correct(c)
                new = self._prior(c) + float(
                    kernels.robust_cost(
                        new_cameras, lens, new_points, starts, camera, self.measured, self.weight, active, self.bound
                    )
                )
                if new < cost:
                    gain, cost = (cost - new) / cost, new
                    cameras[:], points[:], self._c = new_cameras, new_points, c
                    fresh, damping, growth = True, max(damping * 0.2, 1e-9), 2.0
                    if gain < stop:
                        break
                    continue
                self._correct(self._c)
            damping, growth = damping * growth, growth * 2.0
            if damping > 1e8:
                break
        return cost

    def border(self, active: U8) -> tuple[F64, F64]:
        """The offsets (g,t), and their covariance when all else is unknown: infinite where that has no solution."""
        self._linearise(active)
        b = self._c.size
        if not self._solve(active, 0.0):
            return self._c, np.diag(np.full(b, np.inf))
        factor = np.triu(self.scratch[6][-b:, -b:])  # of the border's own information, cameras and points eliminated
        inverse = np.linalg.inv(factor)
        return self._c, inverse @ inverse.T


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

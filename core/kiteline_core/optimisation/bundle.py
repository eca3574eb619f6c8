"""Bundle adjustment of keyframe poses and points with robust pixel and disparity residuals.

Source: B. Triggs et al., "Bundle adjustment, a modern synthesis", 2000, section 6 (Schur complement); the two rounds
with an outlier test between them are those of ORB-SLAM2 and of "DS-PTAM: a distributed stereo PTAM".
"""

from dataclasses import dataclass, field

import numpy as np

from kiteline_core.arrays import F64, I32, U8, Bool
from kiteline_core.optimisation import bundle_border_kernels as border_kernels
from kiteline_core.optimisation import bundle_kernels as kernels

CHI2_2, CHI2_3 = 5.991, 7.815  # 95 % of chi-squares with 2 (a pixel) and 3 (with a disparity) degrees of freedom
_DAMPINGS = (0.0, 1e-6, 1e-4)  # of covariances, in order: a point far away may leave the system without a solution
_MEDIAN_2, _MEDIAN_3 = 1.386, 2.366  # medians of the same


@dataclass(frozen=True, slots=True)
class BundleConfig:
    """Iterations, and bounds of the robust cost."""

    robust_trials: int = 5  # Levenberg-Marquardt trials before the outlier test
    final_trials: int = 5  # trials after it
    stop: float = 1e-4  # relative gain in cost below which more trials have no visible effect
    chi2_mono: float = CHI2_2  # squared normalised residual of a pixel at the knee of Huber's cost: 95 %
    chi2_stereo: float = CHI2_3  # the same of a pixel with disparity


@dataclass(frozen=True, slots=True)
class Border:
    """Disparity offsets that are estimated with the poses and points.

    group: (m,) int32 group of each observation, -1 for no offset. terms: (m,t): the offset to subtract from the
    disparity is terms @ c[group]. start: (g,t) px of c. sigma: (t,) or (g,t) px, standard deviation of c about `mean`
    (g,t), or about 0. tail: standard deviations beyond which the prior flattens (a t distribution), so that it yields
    to data that show a large offset; only for terms whose standard deviation by the data alone is below this share
    `determined` of sigma. worn: factor on sigma where the data contradict it: where their own estimate of a group is
    beyond `contradicts` (g,) (a squared Mahalanobis distance) of what they and sigma allow.
    """

    group: I32
    terms: F64
    start: F64
    sigma: F64
    tail: float = np.inf
    determined: float = 0.7
    worn: float = 1.0
    contradicts: F64 | None = None
    mean: F64 | None = None


@dataclass(frozen=True, slots=True)
class BundleProblem:
    """Input of the adjustment; arrays are never changed.

    T_c_m: (k,4,4) camera poses. lens: (k,5) fx fy cx cy bf. free: (k,) poses that may move. points: (n,3) in m.
    starts: (n + 1,) int32 rows of each point's observations. camera: (m,) int32, increasing inside a point. measured:
    (m,3) u, v, disparity in px, disparity -1 for none; with a border, before subtracting offsets. sigma: (m,2) px of
    pixel and disparity.
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
    """Adjusted poses and points.

    inlier: (m,) observations that passed the outlier test. cost_ops: arithmetic operations. offset: (g,t) px of the
    border and offset_cov: (g*t,g*t), both empty without one. scale_sigma: relative standard deviation of all lengths as
    something besides images tells them; 0 without that.
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
    scale_sigma: float = 0.0


def bundle(problem: BundleProblem, config: BundleConfig) -> BundleResult:
    """Minimise the sum of Huber costs, remove outliers, and minimise again.

    If the residuals are larger than `sigma` predicts, the outlier bound grows with their median.
    """
    solver = _Solver(problem, config) if problem.border is None else _BorderSolver(problem, problem.border, config)
    squared = solver.squared_residuals()
    active = (squared < kernels.BEHIND).astype(np.uint8)
    solver.relax_priors(active)
    cost = initial = solver.robust_cost(active)
    has_disparity = problem.measured[:, 2] >= 0
    limit = np.where(has_disparity, config.chi2_stereo, config.chi2_mono)
    typical = np.where(has_disparity, _MEDIAN_3, _MEDIAN_2)
    for trials in (config.robust_trials, config.final_trials):
        if trials == 0:
            continue
        cost = solver.minimise(active, trials)
        squared = solver.squared_residuals()
        scale = float(np.median(squared[active != 0] / typical[active != 0])) if active.any() else 1.0
        active[:] = squared <= limit * max(scale, 1.0)
    offset, cov = solver.border_estimate(active)
    return BundleResult(
        unpack(solver.cameras), solver.points, active != 0, initial, cost, solver.trials, solver.operations, offset, cov
    )


class _Solver:
    """Levenberg-Marquardt on packed cameras (k,12) and points (n,3), in place."""

    def __init__(self, problem: BundleProblem, config: BundleConfig, border_size: int = 0) -> None:
        """border_size: unknowns besides those of cameras and points."""
        self.cameras = pack(problem.T_c_m)
        self.points = problem.points.astype(np.float64, copy=True)
        self.trials = self._linearisations = self._pairs = 0
        n, m, f = len(self.points), len(problem.camera), int(np.count_nonzero(problem.free))
        self._n_free = f
        self._stop = config.stop
        self._lens, self._starts, self._camera = problem.lens, problem.starts, problem.camera
        self._measured, self._weight = problem.measured, 1.0 / np.square(problem.sigma)
        self._bound = np.array([config.chi2_mono, config.chi2_stereo])
        self._free = np.full(len(self.cameras), -1, np.int32)
        self._free[problem.free] = np.arange(f, dtype=np.int32)
        self._hcc, self._bc = np.empty((f, 6, 6)), np.empty((f, 6))
        self._hpp, self._bp, self._hcp = np.empty((n, 6)), np.empty((n, 3)), np.empty((m, 6, 3))
        self._inv = np.empty((n, 6))
        size = 6 * f + border_size
        self._system, self._rhs = np.empty((size, size)), np.empty(size)
        self._new_cameras, self._new_points = np.empty_like(self.cameras), np.empty_like(self.points)

    def squared_residuals(self) -> F64:
        """Squared normalised residuals (m,) of all observations."""
        out = np.empty(len(self._camera))
        kernels.squared_residuals(
            self.cameras, self._lens, self.points, self._starts, self._camera, self._measured, self._weight, out
        )
        return out

    def robust_cost(self, active: U8) -> float:
        """Sum of Huber costs of the active observations."""
        return self._cost(self.cameras, self.points, active)

    def minimise(self, active: U8, trials: int) -> float:
        """Run up to `trials` trials; returns the cost.

        After a step that fails, damping grows as in H. Nielsen, "Damping parameter in Marquardt's method", 1999; after
        one that succeeds it is a fifth. Ends early if a step lowers the cost by less than the fraction `stop`.
        """
        damping, growth, is_linearised, cost = 1e-4, 2.0, False, 0.0
        for _ in range(trials):
            self.trials += 1
            if not is_linearised:
                cost = self._linearise(active)
                self._linearisations += 1
                is_linearised = True
            if not self._solve(active, damping):
                damping, growth = damping * growth, growth * 2.0
                continue
            new = self._step(active)
            if new < cost:
                gain, cost = (cost - new) / cost, new
                self._accept()
                is_linearised, damping, growth = False, max(damping * 0.2, 1e-9), 2.0
                if gain < self._stop:
                    break
            else:
                self._reject()
                damping, growth = damping * growth, growth * 2.0
                if damping > 1e8:
                    break
        return cost

    @property
    def operations(self) -> int:
        """Cost model of lock-step flights: one operation takes a core 1 ns, as timed on this code.

        An observation costs 55 to linearise and 40 to weigh, a pair of observations 27; cameras have a band of 20.
        """
        f, m = self._n_free, len(self._camera)
        solving = 6 * f * (6 * min(f, 20)) ** 2 // 10
        return 300_000 + self._linearisations * m * 55 + self.trials * (m * 40 + solving) + self._pairs * 27

    def border_estimate(self, active: U8) -> tuple[F64, F64]:
        """Offsets (g,t) and their covariance; empty without a border."""
        return np.empty((0, 0)), np.empty((0, 0))

    def relax_priors(self, active: U8) -> None:
        """Do nothing: only unknowns of a border have priors."""

    def _linearise(self, active: U8) -> float:
        return float(
            kernels.linearise(
                self.cameras, self._lens, self.points, self._starts, self._camera, self._measured, self._weight, active,
                self._bound, self._free, self._hcc, self._bc, self._hpp, self._bp, self._hcp,
            )
        )  # fmt: skip

    def _reduce(self, active: U8, damping: float) -> None:
        self._pairs += int(
            kernels.reduce(
                self._starts, self._camera, active, self._free, damping, self._hcc, self._bc, self._hpp, self._bp,
                self._hcp, self._inv, self._system, self._rhs,
            )
        )  # fmt: skip

    def _solve(self, active: U8, damping: float) -> bool:
        self._reduce(active, damping)
        return bool(kernels.solve(self._system, self._rhs))

    def _step(self, active: U8) -> float:
        """Compute the stepped cameras and points; returns their cost."""
        return self._step_from(active, self._bp)

    def _step_from(self, active: U8, points_rhs: F64) -> float:
        kernels.step(
            self.cameras, self.points, self._starts, self._camera, active, self._free, self._inv, points_rhs,
            self._hcp, self._rhs, self._new_cameras, self._new_points,
        )  # fmt: skip
        return self._cost(self._new_cameras, self._new_points, active)

    def _cost(self, cameras: F64, points: F64, active: U8) -> float:
        return float(
            kernels.robust_cost(
                cameras, self._lens, points, self._starts, self._camera, self._measured, self._weight, active,
                self._bound,
            )
        )  # fmt: skip

    def _accept(self) -> None:
        self.cameras[:], self.points[:] = self._new_cameras, self._new_points

    def _reject(self) -> None:
        """Undo what `_step` changed besides the new cameras and points."""


class _BorderSolver(_Solver):
    """The solver with disparity offsets c (g,t) as further unknowns."""

    def __init__(self, problem: BundleProblem, border: Border, config: BundleConfig) -> None:
        super().__init__(problem, config, border.start.size)
        b, f = border.start.size, self._n_free
        self._raw, self._border = problem.measured, border
        self._c = self._new_c = border.start.astype(np.float64, copy=True)
        self._sigma = np.broadcast_to(border.sigma, border.start.shape).flatten()
        self._mean = np.zeros(b) if border.mean is None else border.mean.ravel()
        self._yields = np.zeros(b, np.bool_)  # terms whose prior flattens
        self._blocks = (np.empty((b, b)), np.empty(b), np.empty((b, 6 * f)), np.empty((len(problem.camera), 3)))
        self._points_rhs = np.empty_like(self.points)
        self._measured = problem.measured.copy()
        self._correct(self._c)

    def border_estimate(self, active: U8) -> tuple[F64, F64]:
        """Offsets (g,t), and their marginal covariance: infinite if the system has no solution."""
        self._linearise(active)
        b = self._c.size
        if not any(self._solve(active, damping) for damping in _DAMPINGS):
            return self._c, np.diag(np.full(b, np.inf))
        factor = np.triu(self._system[-b:, -b:])  # of the border, cameras and points eliminated
        inverse = np.linalg.inv(factor)
        return self._c, inverse @ inverse.T

    def relax_priors(self, active: U8) -> None:
        """Widen the priors of groups that contradict the data, and flatten those of terms that the data determine.

        Each is judged with all other unknowns marginalised.
        """
        if np.isinf(self._border.tail) and self._border.contradicts is None:
            return
        cov = self.border_estimate(active)[1]
        variance = np.diag(cov)
        if not np.isfinite(variance).all():
            return
        if self._border.contradicts is not None:
            self._widen_priors(cov, self._border.contradicts)
        if np.isinf(self._border.tail):
            return
        by_data = 1.0 / np.maximum(1.0 / variance - 1.0 / np.square(self._sigma), 1e-12)
        self._yields = by_data < np.square(self._border.determined * self._sigma)

    def _widen_priors(self, cov: F64, contradicts: F64) -> None:
        """Compare the data's own estimate of each group's offsets with its prior. cov: (b,b) with the prior."""
        total = np.linalg.inv(cov)
        own = total - np.diag(np.square(1.0 / self._sigma)) + 1e-9 * np.eye(len(cov))
        held = np.square(1.0 / self._sigma) * self._mean
        estimate = np.linalg.solve(own, total @ (self._c.ravel() + self._rhs[6 * self._n_free :]) - held) - self._mean
        spread = np.linalg.inv(own) + np.diag(np.square(self._sigma))
        terms = self._c.shape[1]
        for group, limit in enumerate(contradicts.tolist()):
            part = slice(group * terms, (group + 1) * terms)
            distance = float(estimate[part] @ np.linalg.solve(spread[part, part], estimate[part]))
            if distance > limit:
                self._sigma[part] *= self._border.worn

    def _correct(self, c: F64) -> None:
        border_kernels.correct(self._raw, self._border.group, self._border.terms, c, self._measured)

    def _prior(self, c: F64) -> float:
        squared = np.square((c.ravel() - self._mean) / self._sigma)
        tail = self._border.tail if self._yields.any() else 1.0
        return float(np.sum(np.where(self._yields, tail**2 * np.log1p(squared / tail**2), squared)))

    def _prior_weights(self) -> F64:
        """Weight (b,) of the present offsets' squares that has the slope of the prior's cost."""
        ratio = np.where(self._yields, (self._c.ravel() - self._mean) / (self._sigma * self._border.tail), 0.0)
        return np.asarray(1.0 / np.square(self._sigma) / (1.0 + np.square(ratio)))

    def _linearise(self, active: U8) -> float:
        cost = super()._linearise(active)
        border_kernels.accumulate(
            self.cameras, self._lens, self.points, self._starts, self._camera, self._measured, self._weight, active,
            self._bound, self._free, self._border.group, self._border.terms, *self._blocks,
        )  # fmt: skip
        weights = self._prior_weights()
        self._blocks[0][np.diag_indices(len(weights))] += weights
        self._blocks[1][:] -= weights * (self._c.ravel() - self._mean)
        return cost + self._prior(self._c)

    def _solve(self, active: U8, damping: float) -> bool:
        self._reduce(active, damping)
        hbb, bb, hbc, hp = self._blocks
        border_kernels.reduce_border(
            self._starts, self._camera, active, self._free, damping, hbb, bb, hbc, hp, self._bp, self._hcp, self._inv,
            self._border.group, self._border.terms, self._system, self._rhs,
        )  # fmt: skip
        return bool(kernels.solve(self._system, self._rhs))

    def _step(self, active: U8) -> float:
        step = self._rhs[6 * self._n_free :]
        self._new_c = self._c + step.reshape(self._c.shape)
        border_kernels.points_for(
            self._starts, active, self._border.group, self._border.terms, self._blocks[3], self._bp, step,
            self._points_rhs,
        )  # fmt: skip
        self._correct(self._new_c)
        return self._prior(self._new_c) + self._step_from(active, self._points_rhs)

    def _accept(self) -> None:
        super()._accept()
        self._c = self._new_c

    def _reject(self) -> None:
        self._correct(self._c)


def pack(poses: F64) -> F64:
    """Pack poses (k,4,4) into (k,12): rotation row by row, then translation."""
    return np.concatenate([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]], axis=1).astype(np.float64)


def unpack(cameras: F64) -> F64:
    """Unpack (k,12) into poses (k,4,4) with orthonormal rotations."""
    out = np.zeros((len(cameras), 4, 4))
    u, _, vt = np.linalg.svd(cameras[:, :9].reshape(-1, 3, 3))
    out[:, :3, :3] = u @ vt
    out[:, :3, 3] = cameras[:, 9:]
    out[:, 3, 3] = 1.0
    return out

"""Bundle adjustment against numeric differences, plain numpy and an independent solver."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.optimisation import bundle_kernels as kernels
from kiteline_core.optimisation.bundle import BundleConfig, BundleProblem, bundle, pack, unpack

LENS = np.array([400.0, 410.0, 320.0, 240.0, 44.0])


def scene(
    cameras: int, points: int, noise_px: float, seed: int, fixed: int = 1, outliers: float = 0.0
) -> tuple[BundleProblem, F64, F64]:
    """A row of cameras that look at a cloud; returns the disturbed problem, true poses and true points."""
    rng = np.random.default_rng(seed)
    world = np.stack(
        [rng.uniform(-4, 4 + 0.1 * cameras, points), rng.uniform(-3, 3, points), rng.uniform(4, 9, points)], 1
    )
    truth = np.stack(
        [se3.inverse(se3.exp(np.concatenate([[0.1 * i, 0, 0], rng.normal(0, 0.05, 3)]))) for i in range(cameras)]
    )
    rows: list[tuple[int, int, float, float, float]] = []
    starts = [0]
    for p in range(points):
        for c in range(cameras):
            q = se3.transform(truth[c], world[p : p + 1])[0]
            u, v, d = LENS[0] * q[0] / q[2] + LENS[2], LENS[1] * q[1] / q[2] + LENS[3], LENS[4] / q[2]
            if 0 < u < 640 and 0 < v < 480 and rng.random() < 0.8:
                n = rng.normal(0, noise_px, 3)
                if rng.random() < outliers:
                    n += rng.choice([-30.0, 30.0], 3)
                rows.append((c, p, u + n[0], v + n[1], max(d + n[2], 0.1) if rng.random() < 0.7 else -1.0))
        starts.append(len(rows))
    table = np.array(rows)
    free = np.ones(cameras, bool)
    free[:fixed] = False
    start = np.stack([se3.exp(rng.normal(0, 0.02, 6)) @ t if f else t for t, f in zip(truth, free, strict=True)])
    problem = BundleProblem(
        start, np.tile(LENS, (cameras, 1)), free, world + rng.normal(0, 0.1, world.shape),
        np.array(starts, np.int32), table[:, 0].astype(np.int32), table[:, 2:].copy(),
        np.tile([0.5, 0.5], (len(table), 1)) if noise_px else np.ones((len(table), 2)),
    )  # fmt: skip
    return problem, truth, world


def residuals(problem: BundleProblem, poses: F64, points: F64) -> F64:
    """Plain numpy: normalised residuals (m,3), zero where there is no disparity."""
    which = np.repeat(np.arange(len(points)), np.diff(problem.starts))
    q = np.einsum("nij,nj->ni", poses[problem.camera][:, :3, :3], points[which]) + poses[problem.camera][:, :3, 3]
    lens = problem.lens[problem.camera]
    r = np.stack(
        [
            lens[:, 0] * q[:, 0] / q[:, 2] + lens[:, 2],
            lens[:, 1] * q[:, 1] / q[:, 2] + lens[:, 3],
            lens[:, 4] / q[:, 2],
        ],
        1,
    )
    r -= problem.measured
    r[problem.measured[:, 2] < 0, 2] = 0.0
    return r / problem.sigma[:, [0, 0, 1]]


def bounds(problem: BundleProblem, config: BundleConfig) -> F64:
    return np.where(problem.measured[:, 2] >= 0, config.chi2_stereo, config.chi2_mono)


def huber_cost(s: F64, bound: F64) -> F64:
    """Huber's cost of squared residual norms s (n,): s up to `bound`, above it growing with sqrt(s)."""
    outside = s > bound
    root = np.sqrt(np.where(outside, s, 1.0))
    return np.where(outside, 2.0 * np.sqrt(bound) * root - bound, s)


def test_kernel_residuals_agree_with_numpy() -> None:
    problem, _, _ = scene(4, 30, 0.5, 1)
    out = np.empty(len(problem.camera))
    kernels.squared_residuals(
        pack(problem.T_c_m), problem.lens, problem.points, problem.starts, problem.camera, problem.measured,
        1.0 / np.square(problem.sigma), out,
    )  # fmt: skip
    assert np.allclose(out, np.square(residuals(problem, problem.T_c_m, problem.points)).sum(1), rtol=1e-10)


def normal_blocks(points: int, observations: int, free: int) -> tuple[F64, ...]:
    """Room for what `linearise` gives: blocks of cameras, of points and between them."""
    shapes = ((free, 6, 6), (free, 6), (points, 6), (points, 3), (observations, 6, 3))
    return tuple(np.zeros(shape) for shape in shapes)


def test_normal_equations_agree_with_numeric_differences() -> None:
    problem, _, _ = scene(3, 12, 0.5, 2)
    n, m, f = len(problem.points), len(problem.camera), 2
    free = np.array([-1, 0, 1], np.int32)
    hcc, bc, hpp, bp, hcp = blocks = normal_blocks(n, m, f)
    model = (problem.starts, problem.camera, problem.measured, 1.0 / np.square(problem.sigma))
    huge = np.array([1e12, 1e12])
    every = np.ones(m, np.uint8)
    cost = kernels.linearise(pack(problem.T_c_m), problem.lens, problem.points, *model, every, huge, free, *blocks)

    def move(x: F64) -> F64:
        poses = problem.T_c_m.copy()
        for c in (1, 2):
            d = x[6 * (c - 1) : 6 * c]
            turn = se3.from_rt(se3.so3_exp(d[3:]), d[:3])
            poses[c] = turn @ poses[c]
        return residuals(problem, poses, problem.points + x[12:].reshape(-1, 3)).ravel()

    size, e = 12 + 3 * n, 1e-6
    jacobian = np.stack([(move(e * v) - move(-e * v)) / (2 * e) for v in np.eye(size)], 1)
    h, g = jacobian.T @ jacobian, -jacobian.T @ move(np.zeros(size))
    scale = np.abs(h).max()
    assert cost == pytest.approx(float(np.square(move(np.zeros(size))).sum()), rel=1e-10)
    upper = np.triu_indices(6)
    for c in range(f):
        assert np.allclose(hcc[c][upper], h[6 * c : 6 * c + 6, 6 * c : 6 * c + 6][upper], atol=1e-6 * scale)
        assert np.allclose(bc[c], g[6 * c : 6 * c + 6], atol=1e-6 * scale)
    for p in range(n):
        block = slice(12 + 3 * p, 15 + 3 * p)
        assert np.allclose(hpp[p], h[block, block][np.triu_indices(3)], atol=1e-6 * scale)
        assert np.allclose(bp[p], g[block], atol=1e-6 * scale)
        for o in range(problem.starts[p], problem.starts[p + 1]):
            c = free[problem.camera[o]]
            if c >= 0:
                assert np.allclose(hcp[o], h[6 * c : 6 * c + 6, block], atol=1e-6 * scale)


def test_reduced_system_and_its_solution_agree_with_dense_algebra() -> None:
    problem, _, _ = scene(6, 40, 0.5, 3)
    n, m, f = len(problem.points), len(problem.camera), 5
    free = np.arange(-1, 5, dtype=np.int32)
    hcc, bc, hpp, bp, hcp = blocks = normal_blocks(n, m, f)
    model = (problem.starts, problem.camera, problem.measured, 1.0 / np.square(problem.sigma))
    active, bound = np.ones(m, np.uint8), np.array([5.99, 7.81])
    cameras = pack(problem.T_c_m)
    kernels.linearise(cameras, problem.lens, problem.points, *model, active, bound, free, *blocks)
    h, g = np.zeros((6 * f + 3 * n, 6 * f + 3 * n)), np.zeros(6 * f + 3 * n)
    for c in range(f):
        block = np.triu(hcc[c]) + np.triu(hcc[c], 1).T
        h[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] = block
        g[6 * c : 6 * c + 6] = bc[c]
    for p in range(n):
        at = slice(6 * f + 3 * p, 6 * f + 3 * p + 3)
        xx, xy, xz, yy, yz, zz = hpp[p]
        h[at, at] = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        g[at] = bp[p]
        for o in range(problem.starts[p], problem.starts[p + 1]):
            c = free[problem.camera[o]]
            if c >= 0:
                h[6 * c : 6 * c + 6, at] += hcp[o]
                h[at, 6 * c : 6 * c + 6] += hcp[o].T
    damped = h + np.diag(1e-3 * np.diag(h) + 1e-9)
    expected = np.linalg.solve(damped, g)
    inv, s, rhs = np.empty((n, 6)), np.empty((6 * f, 6 * f)), np.empty(6 * f)
    kernels.reduce(problem.starts, problem.camera, active, free, 1e-3, hcc, bc, hpp, bp, hcp, inv, s, rhs)
    assert kernels.solve(s, rhs)
    assert np.allclose(rhs, expected[: 6 * f], rtol=1e-5, atol=1e-9)
    cameras2, points2 = np.empty_like(cameras), np.empty_like(problem.points)
    kernels.step(
        cameras, problem.points, problem.starts, problem.camera, active, free, inv, bp, hcp, rhs, cameras2, points2
    )
    assert np.allclose(points2 - problem.points, expected[6 * f :].reshape(-1, 3), rtol=1e-4, atol=1e-8)
    for c in range(f):
        d = rhs[6 * c : 6 * c + 6]
        moved = se3.from_rt(se3.so3_exp(d[3:]), d[:3]) @ problem.T_c_m[c + 1]
        assert np.allclose(unpack(cameras2)[c + 1], moved, atol=1e-12)


def test_sparse_cholesky_agrees_with_numpy_and_refuses_what_is_not_definite() -> None:
    rng = np.random.default_rng(5)
    a = np.zeros((30, 30))
    for k in range(0, 27, 3):
        j = rng.normal(size=(12, 6))
        a[k : k + 6, k : k + 6] += (j.T @ j)[: 30 - k, : 30 - k]
    a += np.eye(30)
    b = rng.normal(size=30)
    x = b.copy()
    assert kernels.solve(np.triu(a), x)
    assert np.allclose(x, np.linalg.solve(a, b))
    assert not kernels.solve(-np.eye(3), np.ones(3))


@pytest.mark.parametrize("outliers", [0.0, 0.04])
def test_reaches_the_cost_of_an_independent_solver(outliers: float) -> None:
    from scipy.optimize import least_squares  # not above: all workers import this file

    problem, _, _ = scene(4, 25, 0.5, 7, outliers=outliers)
    config = BundleConfig(robust_trials=60, final_trials=0, stop=1e-13)
    bound = bounds(problem, config)

    def whitened(x: F64) -> F64:
        poses = problem.T_c_m.copy()
        for c in range(1, 4):
            poses[c] = se3.exp(x[6 * c - 6 : 6 * c]) @ poses[c]
        r = residuals(problem, poses, problem.points + x[18:].reshape(-1, 3))
        s = np.square(r).sum(1)
        return np.asarray((r * np.sqrt(huber_cost(s, bound) / np.maximum(s, 1e-300))[:, None]).ravel())

    result = bundle(problem, config)
    start = np.zeros(18 + 75)
    if outliers:  # wild observations make more than one minimum: begin in the valley that was found, off its floor
        moved = np.stack([se3.log(a @ se3.inverse(b)) for a, b in zip(result.T_c_m, problem.T_c_m, strict=True)])
        start[:18] = moved[1:].ravel()
        start[18:] = (result.points - problem.points).ravel()
        start += np.random.default_rng(1).normal(0, 1e-3, len(start))
    other = least_squares(whitened, start, method="trf", xtol=1e-15, ftol=1e-15, gtol=1e-12, max_nfev=100)
    assert result.final_cost < 0.5 * result.initial_cost
    assert result.final_cost == pytest.approx(2.0 * other.cost, rel=1e-6)


def test_finds_truth_from_exact_pixels_and_outliers_among_noisy_ones() -> None:
    problem, truth, _ = scene(5, 60, 0.0, 11, fixed=2)
    result = bundle(problem, BundleConfig(robust_trials=30, final_trials=0, stop=1e-12))
    assert result.final_cost < 1e-6
    assert np.allclose(result.T_c_m, truth, atol=1e-5)
    problem, truth, _ = scene(6, 80, 0.4, 13, fixed=2, outliers=0.08)
    result = bundle(problem, BundleConfig())
    error = np.linalg.norm(result.T_c_m[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert error.max() < 0.02 < np.linalg.norm(problem.T_c_m[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    true_squares = np.square(residuals(problem, truth, scene(6, 80, 0.4, 13, fixed=2, outliers=0.08)[2])).sum(1)
    wild = true_squares > 1000
    assert wild.sum() > 10
    assert not result.inlier[wild].any()
    assert result.inlier[~wild].mean() > 0.9


def test_the_same_problem_gives_the_same_bytes_and_is_left_alone() -> None:
    problem, _, _ = scene(5, 40, 0.5, 17)
    before = problem.points.copy(), problem.T_c_m.copy()
    a, b = bundle(problem, BundleConfig()), bundle(problem, BundleConfig())
    assert a.points.tobytes() == b.points.tobytes()
    assert a.T_c_m.tobytes() == b.T_c_m.tobytes()
    assert a.cost_ops == b.cost_ops > 0
    assert np.array_equal(problem.points, before[0])
    assert np.array_equal(problem.T_c_m, before[1])


def test_a_point_behind_a_camera_tells_nothing_and_leaves_no_rubbish() -> None:
    problem, _, _ = scene(3, 12, 0.5, 2)
    n, m = len(problem.points), len(problem.camera)
    poses = problem.T_c_m.copy()
    poses[2, :3] *= -1.0  # all points are behind the third camera
    blocks = tuple(np.full_like(block, np.nan) for block in normal_blocks(n, m, 2))
    model = (problem.starts, problem.camera, problem.measured, 1.0 / np.square(problem.sigma))
    kernels.linearise(
        pack(poses), problem.lens, problem.points, *model, np.ones(m, np.uint8), np.array([5.99, 7.81]),
        np.array([-1, 0, 1], np.int32), *blocks,
    )  # fmt: skip
    hcc, bc, hpp, bp, hcp = blocks
    assert np.isfinite(hpp).all() and np.isfinite(bp).all() and hcc[0].any()
    assert not hcp[problem.camera == 2].any() and not hcc[1].any() and not bc[1].any()


def test_an_observation_from_behind_counts_neither_as_cost_nor_as_inlier() -> None:
    problem, _, _ = scene(4, 40, 0.4, 3, fixed=3)
    poses = problem.T_c_m.copy()
    poses[0] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ poses[0]  # a fixed camera that looks away
    result = bundle(replace(problem, T_c_m=poses), BundleConfig())
    assert not result.inlier[problem.camera == 0].any() and result.inlier[problem.camera != 0].mean() > 0.7
    assert result.initial_cost < 1e5


@pytest.mark.parametrize("noise_px", [0.45, 2.0])
def test_the_outlier_test_is_that_of_each_kind_and_wider_where_all_residuals_are_large(noise_px: float) -> None:
    problem, _, _ = scene(6, 80, noise_px, 13, fixed=2)
    config = BundleConfig(robust_trials=8, final_trials=0)
    result = bundle(problem, config)
    squared = np.square(residuals(problem, result.T_c_m, result.points)).sum(1)
    has_disparity = problem.measured[:, 2] >= 0
    scale = float(np.median(squared / np.where(has_disparity, 2.366, 1.386)))  # medians of chi-squares
    assert (scale > 1.0) == (noise_px > 1.0)
    assert np.array_equal(result.inlier, squared <= bounds(problem, config) * max(scale, 1.0))
    for kind in (has_disparity, ~has_disparity):
        assert 0 < np.count_nonzero(result.inlier[kind]) < np.count_nonzero(kind)

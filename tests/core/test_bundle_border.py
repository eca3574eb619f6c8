"""Offsets of disparities as unknowns of a bundle, against an independent solver and dense algebra."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_core.arrays import F64, U8
from kiteline_core.geometry import se3
from kiteline_core.optimisation.bundle import Border, BundleConfig, BundleProblem, BundleResult, _BorderSolver, bundle

LENS = np.array([400.0, 410.0, 320.0, 240.0, 44.0])
TRUE = np.array([[0.3, -0.4], [-0.2, 0.0]])  # px: constant, and by the x of the image; of two agents
EASY = BundleConfig(robust_trials=60, final_trials=0, stop=0.0, chi2_mono=1e9, chi2_stereo=1e9)


def passage(sigma: float = 10.0, seed: int = 4) -> BundleProblem:
    """Six cameras that pass a cloud sideways, the last three another agent's; the first two stay."""
    rng = np.random.default_rng(seed)
    world = np.stack([rng.uniform(-4, 7, 90), rng.uniform(-3, 3, 90), rng.uniform(3, 12, 90)], 1)
    truth = np.stack([se3.inverse(se3.exp(np.array([0.6 * i, 0.1 * i, 0, 0, 0.03 * i, 0]))) for i in range(6)])
    camera, rows, group, terms, starts = [], [], [], [], [0]
    for p in world:
        for c, T in enumerate(truth):
            x, y, z = se3.transform(T, p[None])[0]
            u, v = LENS[0] * x / z + LENS[2], LENS[1] * y / z + LENS[3]
            if not (0 < u < 640 and 0 < v < 480):
                continue
            term = np.array([1.0, x / z])
            noise = rng.normal(0, 0.2, 3)
            off = term @ TRUE[c // 3] if rng.random() < 0.8 else None
            camera.append(c)
            rows.append([u + noise[0], v + noise[1], -1.0 if off is None else max(LENS[4] / z + off + noise[2], 0.1)])
            group.append(-1 if off is None else c // 3)
            terms.append(term)
        starts.append(len(rows))
    seen = np.diff(starts) >= 2
    keep = np.repeat(seen, np.diff(starts))
    free = np.arange(6) >= 2
    start = np.stack([se3.exp(rng.normal(0, 0.01, 6)) @ T if f else T for T, f in zip(truth, free)])
    return BundleProblem(
        start, np.tile(LENS, (6, 1)), free, world[seen] + rng.normal(0, 0.05, (int(seen.sum()), 3)),
        np.concatenate([[0], np.cumsum(np.diff(starts)[seen])]).astype(np.int32), np.array(camera, np.int32)[keep],
        np.array(rows)[keep], np.full((int(keep.sum()), 2), 0.2),
        Border(np.array(group, np.int32)[keep], np.array(terms)[keep], np.zeros((2, 2)), np.full(2, sigma)),
    )  # fmt: skip


def residuals(problem: BundleProblem, poses: F64, points: F64, c: F64) -> F64:
    which = np.repeat(np.arange(len(points)), np.diff(problem.starts))
    q = np.einsum("nij,nj->ni", poses[problem.camera][:, :3, :3], points[which]) + poses[problem.camera][:, :3, 3]
    off = np.where(problem.border.group >= 0, np.sum(problem.border.terms * c[problem.border.group], axis=1), 0.0)
    r = np.stack([LENS[0] * q[:, 0] / q[:, 2] + LENS[2], LENS[1] * q[:, 1] / q[:, 2] + LENS[3], LENS[4] / q[:, 2]], 1)
    r -= problem.measured - np.stack([0 * off, 0 * off, off], 1)
    r[problem.measured[:, 2] < 0, 2] = 0.0
    return np.concatenate([(r / problem.sigma[:, [0, 0, 1]]).ravel(), (c / problem.border.sigma).ravel()])


def solved(problem: BundleProblem) -> tuple[float, F64, F64]:
    """Cost, offsets and their covariance by an independent solver over all unknowns."""
    from scipy.optimize import least_squares  # not above: all workers import this file

    f = int(problem.free.sum())

    def unpacked(x: F64) -> tuple[F64, F64, F64]:
        poses = problem.T_c_m.copy()
        poses[problem.free] = [se3.exp(d) @ T for d, T in zip(x[: 6 * f].reshape(f, 6), poses[problem.free])]
        return poses, x[6 * f : -4].reshape(-1, 3), x[-4:].reshape(2, 2)

    start = np.concatenate([np.zeros(6 * f), problem.points.ravel(), np.zeros(4)])
    found = least_squares(lambda x: residuals(problem, *unpacked(x)), start, xtol=1e-14, ftol=1e-14, gtol=1e-10)
    cov = np.linalg.inv(found.jac.T @ found.jac)[-4:, -4:]
    return 2.0 * float(found.cost), found.x[-4:].reshape(2, 2), cov


@pytest.mark.parametrize("sigma", [10.0, 0.05])
def test_offsets_and_their_covariance_are_those_of_an_independent_solver(sigma: float) -> None:
    problem = passage(sigma)
    ours = bundle(problem, EASY)
    cost, offset, cov = solved(problem)
    assert ours.final_cost == pytest.approx(cost, rel=1e-6)
    assert np.allclose(ours.offset, offset, atol=1e-4)
    assert np.allclose(ours.offset_cov, cov, rtol=2e-2, atol=1e-8)


def test_offsets_are_found_within_their_covariance() -> None:
    wrong: list[F64] = []
    for seed in range(12):
        ours = bundle(passage(seed=seed), BundleConfig(robust_trials=15, final_trials=10))
        error = (ours.offset - TRUE).ravel()
        wrong.append(error @ np.linalg.solve(ours.offset_cov, error))
    assert 2.0 < np.mean(wrong) < 8.0  # of 4 unknowns


def test_where_it_begins_does_not_matter_and_no_border_is_as_before() -> None:
    problem = passage()
    assert problem.border is not None
    far = replace(problem, border=replace(problem.border, start=TRUE + 0.3))
    a, b = bundle(problem, EASY), bundle(far, EASY)
    assert np.allclose(a.offset, b.offset, atol=1e-5)
    plain = bundle(replace(problem, border=None), BundleConfig())
    assert plain.offset.size == 0

    def key(result: BundleResult) -> bytes:
        return result.T_c_m.tobytes() + result.points.tobytes() + result.offset.tobytes()

    assert key(bundle(problem, EASY)) == key(a)


def test_a_prior_yields_to_data_that_determine_a_large_offset() -> None:
    problem = passage(0.02)
    assert problem.border is not None
    normal = bundle(problem, EASY)
    yields = replace(problem, border=replace(problem.border, tail=2.0, determined=10.0))
    holds = replace(problem, border=replace(problem.border, tail=2.0, determined=0.0))
    large = np.abs(TRUE) > 0.1
    off = np.abs(normal.offset - TRUE)[large].mean()
    assert np.abs(bundle(yields, EASY).offset - TRUE)[large].mean() < 0.6 * off
    assert np.array_equal(bundle(holds, EASY).offset, normal.offset)  # the data determine too little


def test_a_prior_widens_where_the_data_contradict_it() -> None:
    problem = passage(0.02)
    assert problem.border is not None
    narrow = bundle(problem, EASY)
    worn = replace(problem, border=replace(problem.border, worn=100.0, contradicts=np.full(2, 30.0)))
    sure = replace(problem, border=replace(problem.border, worn=100.0, contradicts=np.full(2, 1e6)))
    wide = bundle(worn, EASY)
    free = bundle(passage(2.0), EASY)
    assert np.allclose(wide.offset, free.offset, atol=1e-6)
    assert np.abs(wide.offset - TRUE).max() < 0.15 < np.abs(narrow.offset - TRUE).max()
    assert np.array_equal(bundle(sure, EASY).offset, narrow.offset)


def test_a_prior_stays_where_the_data_agree_with_it() -> None:
    problem = passage(0.02)
    off = np.sum(problem.border.terms * TRUE[problem.border.group], axis=1)
    good = problem.measured.copy()
    good[:, 2] -= np.where(problem.border.group >= 0, off, 0.0)
    true_rig = replace(problem, measured=good)
    may = replace(true_rig, border=replace(problem.border, worn=100.0, contradicts=np.full(2, 30.0)))
    assert np.array_equal(bundle(may, EASY).offset, bundle(true_rig, EASY).offset)


def test_the_cost_of_a_yielding_prior_is_minimal() -> None:
    problem = passage(0.02)
    assert problem.border is not None
    ours = bundle(replace(problem, border=replace(problem.border, tail=2.0, determined=10.0)), EASY)

    def cost(offset: F64) -> float:
        """Of poses and points as found, and another offset."""
        plain = residuals(problem, ours.T_c_m, ours.points, offset)[: -offset.size]
        return float(np.sum(plain**2) + 4.0 * np.sum(np.log1p((offset / 0.02) ** 2 / 4.0)))

    assert cost(ours.offset) == pytest.approx(ours.final_cost, rel=1e-6)
    for step in 1e-3 * np.concatenate([np.eye(4), -np.eye(4)]):
        assert cost(ours.offset + step.reshape(2, 2)) > ours.final_cost


def test_a_prior_about_what_is_known_holds_there() -> None:
    problem = passage(0.02)
    assert problem.border is not None
    off = np.abs(bundle(problem, EASY).offset - TRUE).max()
    known = replace(problem, border=replace(problem.border, mean=TRUE))
    assert np.abs(bundle(known, EASY).offset - TRUE).max() < 0.3 * off
    moved = replace(known, border=replace(problem.border, mean=TRUE + 0.5, worn=100.0, contradicts=np.full(2, 30.0)))
    held = replace(moved, border=replace(problem.border, mean=TRUE + 0.5))
    assert np.abs(bundle(moved, EASY).offset - TRUE).max() < 0.4 * np.abs(bundle(held, EASY).offset - TRUE).max()
    far = passage(1e6)
    assert far.border is not None
    assert np.allclose(  # without a weight its place does not matter
        bundle(replace(far, border=replace(far.border, mean=TRUE + 0.5)), EASY).offset,
        bundle(far, EASY).offset,
        atol=1e-4,
    )


@pytest.mark.parametrize("chi2", [1e9, 4.0])
def test_a_step_is_that_of_the_dense_system(chi2: float) -> None:
    """One trial from a start where some observations are beyond the knee, and one disparity is less than its offset."""
    problem = passage(0.5)
    assert problem.border is not None
    measured = problem.measured.copy()
    low = int(np.flatnonzero(problem.border.group == 0)[0])
    measured[low, 2] = 0.05
    border = replace(problem.border, start=0.5 * TRUE, mean=0.2 * TRUE)
    problem = replace(problem, measured=measured, border=border)
    assert border.terms[low] @ border.start[0] > 0.05  # no disparity is negative: it is taken for 0
    f, n, damping = int(problem.free.sum()), len(problem.points), 1e-4

    def unpacked(x: F64) -> tuple[F64, F64, F64]:
        poses = problem.T_c_m.copy()
        moved = x[: 6 * f].reshape(f, 6)
        poses[problem.free] = [se3.from_rt(se3.so3_exp(d[3:]), d[:3]) @ T for d, T in zip(moved, poses[problem.free])]
        return poses, problem.points + x[6 * f : -4].reshape(-1, 3), border.start + x[-4:].reshape(2, 2)

    def whitened(x: F64) -> F64:
        poses, points, c = unpacked(x)
        r = residuals(problem, poses, points, c)
        r[-4:] -= (border.mean / border.sigma).ravel()
        return r

    size, e = 6 * f + 3 * n + 4, 1e-6
    j = np.stack([(whitened(e * v) - whitened(-e * v)) / (2 * e) for v in np.eye(size)], 1)
    r = whitened(np.zeros(size))
    r[3 * low + 2] -= (border.terms[low] @ border.start[0] - 0.05) / problem.sigma[low, 1]
    squared = np.square(r[:-4].reshape(-1, 3)).sum(1)
    weight = np.append(np.repeat(np.sqrt(np.minimum(1.0, np.sqrt(chi2 / squared))), 3), np.ones(4))
    assert (weight < 1.0).any() == (chi2 < 1e3)
    j, r = weight[:, None] * j, weight * r
    h = j.T @ j
    x = np.linalg.solve(h + np.diag(damping * np.diag(h) + 1e-9), -j.T @ r)
    poses, points, c = unpacked(x)
    ours = bundle(problem, BundleConfig(robust_trials=1, final_trials=0, stop=0.0, chi2_mono=chi2, chi2_stereo=chi2))
    assert ours.final_cost < ours.initial_cost
    assert np.allclose(ours.T_c_m, poses, atol=1e-5)
    assert np.allclose(ours.points, points, atol=1e-4)
    assert np.allclose(ours.offset, c, atol=1e-4)


def test_a_prior_is_widened_from_the_distance_on_that_data_and_prior_allow() -> None:
    """The squared Mahalanobis distance of each group's own estimate to the prior's mean, by both covariances."""
    own, worn, mean = bundle(passage(1e6), EASY), 100.0, 0.5 * TRUE
    narrow = passage(0.05)
    assert narrow.border is not None
    at_own = replace(
        narrow, T_c_m=own.T_c_m, points=own.points, border=replace(narrow.border, start=own.offset, mean=mean)
    )
    off = own.offset - mean
    spread = [own.offset_cov[2 * g : 2 * g + 2, 2 * g : 2 * g + 2] + 0.05**2 * np.eye(2) for g in range(2)]
    distance = np.array([off[g] @ np.linalg.solve(spread[g], off[g]) for g in range(2)])
    for wide in (0, 1):
        limit = distance * np.where(np.arange(2) == wide, 0.97, 1.03)
        judged = replace(at_own, border=replace(at_own.border, worn=worn, contradicts=limit))
        sigma = np.where(np.arange(2)[:, None] == wide, worn, 1.0) * np.full((2, 2), 0.05)
        expected = bundle(replace(at_own, border=replace(at_own.border, sigma=sigma)), EASY).offset
        assert np.allclose(bundle(judged, EASY).offset, expected, atol=1e-9)


def test_a_prior_does_not_yield_to_data_that_know_less_than_itself() -> None:
    """With the prior a term is known better than by it alone, however little the data tell."""
    by_data = np.sqrt(np.diag(bundle(passage(1e6), EASY).offset_cov)).reshape(2, 2)
    problem = passage()
    assert problem.border is not None
    problem = replace(problem, border=replace(problem.border, sigma=by_data / 3.0))
    yields = replace(problem, border=replace(problem.border, tail=2.0, determined=0.98))
    assert np.array_equal(bundle(yields, EASY).offset, bundle(problem, EASY).offset)


def test_a_step_that_is_rejected_leaves_disparities_as_they_were() -> None:
    problem = passage()
    assert problem.border is not None

    class Overshooting(_BorderSolver):
        def _solve(self, active: U8, damping: float) -> bool:
            solved = super()._solve(active, damping)
            self._rhs *= -50.0
            return solved

    solver = Overshooting(problem, problem.border, EASY)
    active, before = np.ones(len(problem.camera), np.uint8), solver.squared_residuals()
    assert solver.minimise(active, 1) == solver.robust_cost(active)
    assert np.array_equal(solver.squared_residuals(), before)

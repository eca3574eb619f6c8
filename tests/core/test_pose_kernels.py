"""Motion-only optimisation: it finds the pose, ignores outliers, and weighs points by how well they are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_core.arrays import F64, Bool
from kiteline_core.geometry import se3
from kiteline_core.pose import pose_kernels

CAMERA = np.array([450.0, 450.0, 370.0, 240.0, 50.0])


def scene(seed: int, n: int) -> tuple[F64, F64, F64]:
    """True T_c_m, points (n,3) and exact observations (n,3)."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(0, [0.3, 0.3, 0.3, 0.2, 0.2, 0.2]))
    in_camera = np.column_stack([rng.uniform(-2, 2, n), rng.uniform(-1.2, 1.2, n), rng.uniform(1.5, 8, n)])
    points = se3.transform(se3.inverse(T), in_camera)
    return T, points, project(T, points)


def project(T: F64, points: F64) -> F64:
    p = se3.transform(T, points)
    fx, fy, cx, cy, bf = CAMERA
    return np.column_stack([fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy, bf / p[:, 2]])


def optimise(T: F64, points: F64, observed: F64, ray: F64 | None = None, chi2: float = 9.21) -> tuple[F64, Bool, int]:
    n = len(points)
    out, inlier = T.copy(), np.ones(n, np.bool_)
    count, _ = pose_kernels.optimise_pose(
        out, points, np.zeros((n, 3)) if ray is None else ray, observed, np.full(n, 0.3), CAMERA, 3, 6, chi2,
        inlier,
    )  # fmt: skip
    return out, inlier, count


def distance(a: F64, b: F64) -> float:
    return float(np.linalg.norm(se3.log(se3.inverse(a) @ b)))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), mono=st.booleans())
def test_exact_observations_give_the_exact_pose(seed: int, mono: bool) -> None:
    T, points, observed = scene(seed, 60)
    if mono:
        observed[:, 2] = -1.0
    start = se3.exp(np.array([0.05, -0.04, 0.06, 0.02, -0.03, 0.01])) @ T
    out, inlier, count = optimise(start, points, observed)
    assert distance(out, T) < 1e-5
    assert count == 60 and inlier.all()


def test_outliers_leave() -> None:
    rng = np.random.default_rng(3)
    T, points, observed = scene(3, 120)
    noisy = observed + rng.normal(0, 0.3, observed.shape)
    noisy[:30, :2] += rng.uniform(15, 60, (30, 2))
    out, inlier, count = optimise(se3.exp(np.full(6, 0.01)) @ T, points, noisy)
    assert not inlier[:30].any()
    assert count > 80
    assert distance(out, T) < 0.01


def test_same_answer_as_an_independent_solver() -> None:
    from scipy.optimize import least_squares  # not above: all workers import this file

    rng = np.random.default_rng(4)
    T, points, observed = scene(4, 50)
    noisy = observed + rng.normal(0, 0.2, observed.shape)
    rays = rng.normal(0, 0.02, points.shape)
    out, *_ = optimise(T, points, noisy, rays, chi2=1e6)

    def residuals(xi: F64) -> F64:
        pose = se3.exp(xi) @ out
        r = project(pose, points) - noisy
        step = 1e-6
        v = (project(pose, points + step * rays) - project(pose, points)) / step
        whitened = []
        for k in range(len(points)):
            covariance = 0.09 * np.eye(3) + np.outer(v[k], v[k])
            whitened.append(np.linalg.solve(np.linalg.cholesky(covariance), r[k]))
        return np.concatenate(whitened)

    best = least_squares(residuals, np.zeros(6), x_scale=0.01, ftol=1e-15, xtol=1e-15, gtol=1e-15)
    ours = 0.5 * float(residuals(np.zeros(6)) @ residuals(np.zeros(6)))
    assert ours == pytest.approx(best.cost, rel=1e-3)  # weights are held fixed within a step: not the very same minimum


def test_badly_known_points_hardly_count() -> None:
    T, points, _ = scene(5, 40)
    wrong = points.copy()
    centre = se3.inverse(T)[:3, 3]
    sight = points[:20] - centre
    wrong[:20] += 0.3 * sight  # depth wrong by 30 %, seen from a metre aside it matters
    moved = se3.exp(np.array([0.4, 0, 0, 0, 0, 0])) @ T
    ray = np.zeros_like(points)
    ray[:20] = 0.3 * sight
    seen = project(moved, points)
    told, *_ = optimise(moved, wrong, seen, ray, chi2=1e6)
    untold, *_ = optimise(moved, wrong, seen, chi2=1e6)
    assert distance(told, moved) < 0.2 * distance(untold, moved)

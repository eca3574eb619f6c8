"""Absolute pose: P3P against constructed truth, RANSAC among outliers."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from kiteline_core.geometry import se3
from kiteline_core.pose import pnp, pnp_kernels, ransac_kernels
from tests.core.helpers_from_python import from_python

CAMERA = np.array([450.0, 455.0, 370.0, 245.0, 50.0])


def scene(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n,3) before a camera in a random pose, the pose T_c_m, and exact pixels (n,2)."""
    local = np.column_stack([rng.uniform(-2, 2, n), rng.uniform(-1.3, 1.3, n), rng.uniform(2, 9, n)])
    local[:, :2] *= local[:, 2:] / 4.0
    T = se3.exp(np.concatenate([rng.normal(0, 3, 3), rng.normal(0, 1.2, 3)]))
    uv = local[:, :2] / local[:, 2:] * CAMERA[:2] + CAMERA[2:4]
    return se3.transform(se3.inverse(T), local), T, uv


@given(st.integers(0, 10**9))
def test_p3p_contains_the_true_pose_and_only_poses_that_fit(seed: int) -> None:
    points, T, uv = scene(np.random.default_rng(seed), 3)
    ray = np.column_stack([(uv - CAMERA[2:4]) / CAMERA[:2], np.ones(3)])
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    area = np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0]))
    assume(area > 0.3)  # nearly on a line, no pose is certain
    found = np.empty((4, 4, 4))
    n = from_python(pnp_kernels.p3p)(ray, points, found)
    for k in range(n):
        seen = se3.transform(found[k], points)
        cosine = np.einsum("ni,ni->n", seen, ray) / np.linalg.norm(seen, axis=1)
        assert cosine.min() > 1 - 1e-9
        assert np.allclose(found[k, :3, :3] @ found[k, :3, :3].T, np.eye(3), atol=1e-9)
    assert n > 0
    assert min(np.abs(found[k] - T).max() for k in range(n)) < 1e-4


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
def test_pose_among_outliers(share: float) -> None:
    rng = np.random.default_rng(5)
    for trial in range(8):
        points, T, uv = scene(rng, 90)
        bad = rng.permutation(90)[: int(90 * share)]
        uv += rng.normal(0, 0.4, uv.shape)
        uv[bad] = rng.uniform(0, 480, (len(bad), 2))
        observed = np.column_stack([uv, np.full(90, -1.0)])
        fit = pnp.solve_pnp(points, np.zeros((90, 3)), observed, np.zeros(90, np.uint8), CAMERA, trial)
        error = se3.log(fit.T_c_m @ se3.inverse(T))
        assert np.linalg.norm(error[:3]) < 0.05 and np.linalg.norm(error[3:]) < 0.01
        assert np.count_nonzero(fit.inlier[bad]) <= 1 and fit.inliers >= 90 - len(bad) - 3


def test_no_pose_from_noise_or_from_too_few() -> None:
    rng = np.random.default_rng(1)
    points, _, uv = scene(rng, 60)
    observed = np.column_stack([rng.permutation(uv), np.full(60, -1.0)])
    fit = pnp.solve_pnp(points, np.zeros((60, 3)), observed, np.zeros(60, np.uint8), CAMERA, 0)
    assert fit is None or fit.inliers < 12
    assert pnp.solve_pnp(points[:3], np.zeros((3, 3)), observed[:3], np.zeros(3, np.uint8), CAMERA, 0) is None
    same = np.repeat(points[:1], 8, axis=0)
    assert pnp.solve_pnp(same, np.zeros((8, 3)), observed[:8], np.zeros(8, np.uint8), CAMERA, 0) is None


def test_the_same_seed_gives_the_same_bits_and_draws_end_early() -> None:
    points, _, uv = scene(np.random.default_rng(2), 50)
    observed = np.column_stack([uv, np.full(50, -1.0)])
    args = points, np.zeros((50, 3)), observed, np.zeros(50, np.uint8), CAMERA
    one, two = pnp.solve_pnp(*args, 7), pnp.solve_pnp(*args, 7)
    assert one.T_c_m.tobytes() == two.T_c_m.tobytes()
    state, again = np.array([7], np.uint64), np.array([7], np.uint64)
    T, inlier = np.eye(4), np.zeros(50, np.bool_)
    pnp_kernels.p3p_ransac(points, uv, np.full(50, 3.0), CAMERA, 1000, 0.99, state, T, inlier)
    for _ in range(12):  # fewer than four triples were drawn: all points are inliers of the first pose
        from_python(ransac_kernels.draw)(again, 50)
        if again[0] == state[0]:
            return
    pytest.fail("draws went on although all points agreed")

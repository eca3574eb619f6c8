"""Alignment of point sets against a plain SVD, and of two views among outliers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_basestation.merging.similarity import align_points, align_views
from kiteline_core.geometry import se3, sim3

CAMERA = np.array([450.0, 455.0, 370.0, 245.0, 50.0])


def scene(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n,3) before a camera in a random pose, the pose T_c_m, and exact pixels (n,2)."""
    local = np.column_stack([rng.uniform(-2, 2, n), rng.uniform(-1.3, 1.3, n), rng.uniform(2, 9, n)])
    local[:, :2] *= local[:, 2:] / 4.0
    T = se3.exp(np.concatenate([rng.normal(0, 3, 3), rng.normal(0, 1.2, 3)]))
    uv = local[:, :2] / local[:, 2:] * CAMERA[:2] + CAMERA[2:4]
    return se3.transform(se3.inverse(T), local), T, uv


def svd_alignment(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rotation and translation by SVD (S. Umeyama, 1991)."""
    u, _, vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    r = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return se3.from_rt(r, a.mean(0) - r @ b.mean(0))


@given(st.integers(0, 10**9), st.integers(4, 30))
def test_alignment_is_that_of_an_svd(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    b = rng.normal(0, 2, (n, 3))
    T = se3.exp(rng.normal(0, 1.5, 6))
    a = se3.transform(T, b) + rng.normal(0, 0.02, b.shape)
    found = align_points(a, b)
    assert np.allclose(found, svd_alignment(a, b), atol=1e-7)


def test_scale_is_found_and_a_line_is_refused() -> None:
    rng = np.random.default_rng(3)
    b = rng.normal(0, 2, (9, 3))
    T = se3.exp(rng.normal(0, 1.0, 6))
    found = align_points(2.5 * se3.transform(T, b), b, with_scale=True)
    assert np.allclose(found[:3, :3], 2.5 * T[:3, :3])
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert align_points(line, line) is None
    assert align_points(b[:2], b[:2]) is None


@pytest.mark.parametrize("with_scale", [False, True])
def test_views_are_aligned_among_outliers(with_scale: bool) -> None:
    rng = np.random.default_rng(4)
    scale = 1.7 if with_scale else 1.0
    points, T_a, uv_a = scene(rng, 80)
    a = se3.transform(T_a, points)
    move = se3.exp(np.array([0.4, -0.2, 0.3, 0.05, -0.1, 0.08]))
    b = se3.transform(se3.inverse(move), a) / scale
    uv_b = b[:, :2] / b[:, 2:] * CAMERA[:2] + CAMERA[2:4]
    bad = rng.permutation(80)[:35]
    b[bad], uv_b[bad] = b[np.roll(bad, 1)], uv_b[np.roll(bad, 1)]
    octave = np.zeros(80, np.uint8)
    noisy = a + rng.normal(0, 0.004, a.shape)
    fit = align_views(noisy, uv_a, octave, CAMERA, b, uv_b, octave, CAMERA, with_scale=with_scale, seed=1)
    assert fit.inliers >= 43 and not fit.inlier[bad].any()
    assert abs(fit.scale - scale) < 0.01 * scale
    assert np.abs(fit.S_a_b[:3, 3] - move[:3, 3]).max() < 0.03


@given(st.integers(0, 1 << 32), st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6), st.floats(0.1, 10.0))
def test_points_give_a_similarity(seed: int, xi: list[float], scale: float) -> None:
    T = se3.exp(np.array(xi))
    points = np.random.default_rng(seed).normal(0.0, 2.0, (12, 3))
    S = align_points(scale * points @ T[:3, :3].T + T[:3, 3], points, with_scale=True)
    assert np.allclose(S, sim3.of(scale, T), atol=1e-7)


def views(n: int) -> tuple[np.ndarray, ...]:
    """Points (n,3) in two cameras, their pixels (n,2) in both, and octaves (n,)."""
    points, T_a, uv_a = scene(np.random.default_rng(7), n)
    a = se3.transform(T_a, points)
    b = se3.transform(se3.inverse(se3.exp(np.array([0.9, -0.5, 0.3, 0.05, -0.1, 0.08]))), a)
    return a, uv_a, b, b[:, :2] / b[:, 2:] * CAMERA[:2] + CAMERA[2:4], np.zeros(n, np.uint8)


def test_pairs_have_to_agree_in_both_images() -> None:
    a, uv_a, b, uv_b, octave = views(60)
    a[:12] *= 1.5  # each still lies on its pixel, and is seen elsewhere from the other camera
    b[12:24] *= 1.5
    fit = align_views(a, uv_a, octave, CAMERA, b, uv_b, octave, CAMERA, with_scale=False, seed=1)
    assert not fit.inlier[:24].any() and fit.inlier[24:].all()


def test_a_similarity_is_that_of_all_its_inliers() -> None:
    a, uv_a, b, uv_b, octave = views(60)
    noisy = a + np.random.default_rng(8).normal(0.0, 0.002, a.shape)
    fit = align_views(noisy, uv_a, octave, CAMERA, b, uv_b, octave, CAMERA, with_scale=True, seed=1)
    assert fit.inliers == 60  # also by three of them alone
    assert np.allclose(fit.S_a_b, align_points(noisy, b, with_scale=True), atol=1e-12)


def test_one_point_alone_gives_no_similarity() -> None:
    rng = np.random.default_rng(9)
    for _ in range(50):
        same, others = np.repeat(rng.normal(0.0, 3.0, (1, 3)), 3, axis=0), rng.normal(0.0, 3.0, (3, 3))
        assert align_points(same, others, with_scale=True) is None
        assert align_points(others, same, with_scale=True) is None

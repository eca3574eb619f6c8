"""Motion from two views: exact on clean scenes, sure under noise and outliers, silent where nothing tells."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_agent.initialisation import two_view_models
from kiteline_agent.initialisation.two_view import TwoView, two_view
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

CAMERA = np.array([450.0, 455.0, 372.0, 238.0])
SIZE = np.array([752.0, 480.0])


def scene(random: np.random.Generator, flat: bool, n: int = 260) -> F64:
    """Points (n,3) seen all over the image of a camera at the origin; flat: on one slanted plane."""
    uv = random.uniform(20.0, SIZE - 20.0, (n, 2))
    ray = np.column_stack([(uv - CAMERA[2:]) / CAMERA[:2], np.ones(n)])
    if flat:
        normal = np.array([0.3, -0.2, 1.0])
        return ray * (4.0 / (ray @ normal))[:, None]
    return ray * random.uniform(2.0, 9.0, (n, 1))


def pixels(points: F64, T_c_a: F64) -> F64:
    local = se3.transform(T_c_a, points)
    return np.asarray(local[:, :2] / local[:, 2:] * CAMERA[:2] + CAMERA[2:])


def seen(flat: bool, T_b_a: F64, noise_px: float = 0.0, outliers: int = 0, seed: int = 0) -> tuple[F64, F64, F64]:
    random = np.random.default_rng(seed)
    points = scene(random, flat)
    a = pixels(points, np.eye(4)) + random.normal(0.0, noise_px, (len(points), 2))
    b = pixels(points, T_b_a) + random.normal(0.0, noise_px, (len(points), 2))
    b[:outliers] = random.uniform([0.0, 0.0], SIZE, (outliers, 2))
    return points, a, b


def motion(x: float = 0.4, z: float = 0.1) -> F64:
    return se3.exp(np.array([x, -0.1, z, 0.02, -0.05, 0.03]))


def errors(result: TwoView, T_b_a: F64) -> tuple[float, float]:
    """Angles in rad of the rotation's error and between the directions of translation."""
    along = T_b_a[:3, 3] / np.linalg.norm(T_b_a[:3, 3])
    turned = float(np.linalg.norm(se3.so3_log(result.T_b_a[:3, :3] @ T_b_a[:3, :3].T)))
    return turned, float(np.arccos(np.clip(result.T_b_a[:3, 3] @ along, -1.0, 1.0)))


@pytest.mark.parametrize("flat", [True, False])
def test_clean_matches_give_the_motion_and_the_scene(flat: bool) -> None:
    T_b_a = motion()
    points, a, b = seen(flat, T_b_a)
    result = two_view(a, b, CAMERA, 0)
    assert result.flat == flat
    assert max(errors(result, T_b_a)) < 1e-4
    scale = float(np.linalg.norm(T_b_a[:3, 3]))
    np.testing.assert_allclose(result.points[result.good] * scale, points[result.good], rtol=2e-3)
    assert np.linalg.norm(result.T_b_a[:3, 3]) == pytest.approx(1.0)


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_noise_and_outliers_are_borne(flat: bool, seed: int) -> None:
    T_b_a = motion()
    _, a, b = seen(flat, T_b_a, noise_px=0.3, outliers=60, seed=seed)
    result = two_view(a, b, CAMERA, seed)
    turned, aside = errors(result, T_b_a)
    assert turned < 0.01 and aside < 0.06
    assert np.count_nonzero(result.good[:60]) < 12
    assert np.count_nonzero(result.good[60:]) > 120


def test_forward_motion_leaves_out_points_without_parallax() -> None:
    T_b_a = se3.from_rt(np.eye(3), np.array([0.0, 0.0, -0.9]))
    points, a, b = seen(False, T_b_a, noise_px=0.2)
    result = two_view(a, b, CAMERA, 0)
    assert result is not None and max(errors(result, T_b_a)) < 0.03
    near_axis = np.linalg.norm(points[:, :2] / points[:, 2:], axis=1) < 0.01
    assert not result.good[near_axis].any()


def test_a_mere_turn_says_nothing() -> None:
    _, a, b = seen(False, se3.exp(np.array([0.0, 0.0, 0.0, 0.05, 0.1, 0.0])), noise_px=0.3)
    assert two_view(a, b, CAMERA, 0) is None


def test_no_motion_and_no_relation_say_nothing() -> None:
    random = np.random.default_rng(0)
    _, a, b = seen(False, np.eye(4), noise_px=0.2)
    assert two_view(a, b, CAMERA, 0) is None
    assert two_view(a, random.uniform([0.0, 0.0], SIZE, a.shape), CAMERA, 0) is None
    assert two_view(a[:99], a[:99] + 5.0, CAMERA, 0) is None


def test_the_same_seed_gives_the_same_bits() -> None:
    _, a, b = seen(False, motion(), noise_px=0.5, outliers=80)
    first, second = (two_view(a, b, CAMERA, 7) for _ in range(2))
    assert first.T_b_a.tobytes() == second.T_b_a.tobytes() and first.points.tobytes() == second.points.tobytes()


@given(st.integers(0, 10_000), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_models_explain_what_they_were_made_from(seed: int, x: float, z: float) -> None:
    T_b_a = motion(x, z)
    _, a, b = seen(True, T_b_a, seed=seed)
    h, score, inlier = two_view_models.homography(a, b, 20, 1.0, seed)
    assert inlier.all() and score == pytest.approx(2 * 5.991 * len(a), rel=1e-6)
    mapped = np.column_stack([a, np.ones(len(a))]) @ h.T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], b, atol=1e-5)
    _, a, b = seen(False, T_b_a, seed=seed)
    f, score, inlier = two_view_models.fundamental(a, b, 20, 1.0, seed)
    assert inlier.all() and score == pytest.approx(2 * 5.991 * len(a), rel=1e-6)
    assert abs(np.linalg.det(f / np.linalg.norm(f))) < 1e-9

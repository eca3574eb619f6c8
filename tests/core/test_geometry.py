"""Rigid motions, similarities, triangulation, rates and order statistics, against plain numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.end_rates import end_rates
from kiteline_core.geometry.triangulation import nearest_point, parallax, project, rays
from kiteline_core.order_statistics import median, quantiles


def _matrix_exponential(a: F64) -> F64:
    """By its series, of a 64th of the matrix, squared six times."""
    out, term = np.eye(len(a)), np.eye(len(a))
    for n in range(1, 20):
        term = term @ (a / 64.0) / n
        out = out + term
    for _ in range(6):
        out = out @ out
    return out


def _twists() -> list[F64]:
    rng = np.random.default_rng(3)
    return [rng.normal(size=6) * size for size in (0.0, 1e-9, 1e-7, 1e-5, 1e-4, 1e-2, 0.3, 1.0) for _ in range(20)]


def test_exp_is_the_matrix_exponential() -> None:
    for xi in _twists():
        a = np.zeros((4, 4))
        a[:3, :3], a[:3, 3] = se3.skew(xi[3:]), xi[:3]
        expected = _matrix_exponential(a)
        np.testing.assert_allclose(se3.exp(xi), expected, atol=2e-13)
        np.testing.assert_allclose(se3.so3_exp(xi[3:]), expected[:3, :3], atol=2e-13)


def test_log_inverts_exp() -> None:
    for xi in _twists():
        if np.linalg.norm(xi[3:]) < 3.1:
            np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, rtol=1e-9, atol=1e-15)


def test_inverse() -> None:
    for xi in _twists():
        T = se3.exp(xi)
        np.testing.assert_allclose(se3.inverse(T), np.linalg.inv(T), atol=1e-14)


@pytest.mark.parametrize("error", [0.0, 1e-12, 1e-9, 1e-7, 1e-4, 1e-2])
def test_orthonormalise_is_the_polar_factor(error: float) -> None:
    rng = np.random.default_rng(4)
    for xi in _twists():
        T = se3.exp(xi)
        T[:3, :3] += error * rng.uniform(-1.0, 1.0, (3, 3))
        u, _, vt = np.linalg.svd(T[:3, :3])
        out = se3.orthonormalise(T)
        np.testing.assert_allclose(out[:3, :3], u @ vt, atol=5e-15)
        np.testing.assert_array_equal(out[:, 3], T[:, 3])


def test_a_motion_that_is_no_number_raises() -> None:
    T = np.eye(4)
    T[1, 1] = np.nan
    with pytest.raises(np.linalg.LinAlgError):
        se3.orthonormalise(T)


def test_is_rotation() -> None:
    r = se3.so3_exp(np.array([0.3, -1.0, 2.0]))
    assert se3.is_rotation(r, 1e-12)
    for i in range(3):
        for j in range(3):
            off = r.copy()
            off[i, j] += 0.01
            assert se3.is_rotation(off, 1e-3) == bool(np.abs(off @ off.T - np.eye(3)).max() < 1e-3)
            assert se3.is_rotation(off, 0.1)


def test_quaternion_of_half_turns_and_others() -> None:
    turns = [np.pi * axis for axis in np.eye(3)] + [xi[3:] for xi in _twists()]
    for w in turns:
        r = se3.so3_exp(w)
        q = se3.quaternion_from_rotation(r)
        assert q[0] >= 0.0
        np.testing.assert_allclose(se3.rotation_from_quaternion(q), r, atol=1e-14)


def test_many_quaternions_are_converted_as_each_is() -> None:
    turns = [np.pi * axis for axis in np.eye(3)] + [xi[3:] for xi in _twists()]
    r = np.array([se3.so3_exp(w) for w in turns])
    q = np.array([se3.quaternion_from_rotation(one) for one in r])
    assert {int(np.argmax(np.abs(one))) for one in q} == {0, 1, 2, 3}
    t, q = r[:, 0], 0.7 * q
    assert np.array_equal(se3.from_quaternions(q, t), [se3.from_quaternion(*one) for one in zip(q, t)])


def test_shift_and_turn_are_norms() -> None:
    for xi in _twists():
        T = se3.exp(xi)
        shift, turn = se3.shift_and_turn(T)
        assert shift == pytest.approx(float(np.linalg.norm(T[:3, 3])), rel=1e-14)
        assert turn == pytest.approx(float(np.linalg.norm(T[:3, :3] - np.eye(3))) / np.sqrt(2.0), rel=1e-12)


@st.composite
def rigid_motions(draw: st.DrawFn) -> F64:
    rng = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    return se3.exp(np.concatenate([rng.normal(0.0, 5.0, 3), rng.normal(0.0, 1.0, 3)]))


scales = st.floats(0.01, 100.0)


@given(rigid_motions(), scales)
def test_a_similarity_is_a_rigid_motion_and_a_scale(T: F64, scale: float) -> None:
    S = sim3.of(scale, T)
    assert np.isclose(sim3.scale_of(S), scale, rtol=1e-12)
    assert np.allclose(sim3.rigid(S), T, atol=1e-12)
    assert np.allclose(sim3.normalise(S), S, rtol=1e-9, atol=1e-12)
    points = np.arange(12.0).reshape(4, 3)
    assert np.allclose(se3.transform(S, points), scale * points @ T[:3, :3].T + T[:3, 3])


@given(rigid_motions(), rigid_motions(), rigid_motions(), scales, scales)
def test_group(A: F64, B: F64, T: F64, a: float, b: float) -> None:
    Sa, Sb = sim3.of(a, A), sim3.of(b, B)
    assert np.allclose(sim3.inverse(Sa) @ Sa, np.eye(4), atol=1e-9)
    assert np.isclose(sim3.scale_of(Sa @ Sb), a * b, rtol=1e-9)
    back = sim3.inverse(sim3.normalise(Sa @ Sb))
    assert np.allclose(back, sim3.inverse(Sb) @ sim3.inverse(Sa), rtol=1e-6, atol=1e-6 / min(a * b, 1.0))
    # A body that is carried by one after the other, or by both at once, stands at one place.
    once, twice = sim3.place(Sa @ Sb, T), sim3.place(Sa, sim3.place(Sb, T))
    assert np.allclose(once, twice, rtol=1e-9, atol=1e-6)
    assert np.allclose(sim3.place(sim3.inverse(Sa), sim3.place(Sa, T)), T, atol=1e-7)
    assert np.allclose(sim3.place(Sa, np.stack([T, A]))[0], sim3.place(Sa, T))


@given(rigid_motions(), rigid_motions(), scales, scales)
def test_what_grows_about_a_body_leaves_it_there(A: F64, T: F64, a: float, factor: float) -> None:
    S = sim3.of(a, A)
    longer = sim3.scaled_about(S, factor, T)
    assert np.isclose(sim3.scale_of(longer), a * factor, rtol=1e-9)
    assert np.allclose(sim3.place(longer, T), sim3.place(S, T), atol=1e-6 * max(1.0, a * factor))


@given(rigid_motions(), rigid_motions())
def test_rigid_motions_are_treated_as_ever(A: F64, T: F64) -> None:
    assert sim3.scale_of(A) == 1.0
    assert np.array_equal(sim3.of(1.0, A), A)
    assert np.array_equal(sim3.inverse(A), se3.inverse(A))
    assert np.array_equal(sim3.place(A, T), A @ T)
    assert np.array_equal(sim3.normalise(A), se3.orthonormalise(A))


def turning(t_s: float) -> np.ndarray:
    """1 m/s^2 along x, and yaw that speeds up by 0.8 rad/s^2."""
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, 0.4 * t_s**2])), np.array([0.5 * t_s**2, 0.2 * t_s, 0.0]))


def test_not_late_while_accelerating() -> None:
    t_s = np.arange(1.0, 1.21, 0.05)
    velocity, rate = end_rates([round(t * 1e9) for t in t_s], [turning(t) for t in t_s], round(1.23e9))
    np.testing.assert_allclose(velocity, [1.23, 0.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(rate, [0.0, 0.0, 0.8 * 1.23], atol=1e-6)


def test_no_noisier_than_a_difference() -> None:
    rng = np.random.default_rng(1)
    fitted, differences = [], []
    for _ in range(300):
        poses = [se3.from_rt(np.eye(3), rng.normal(0.0, 0.003, 3)) for _ in range(5)]
        fitted.append(end_rates([i * 50_000_000 for i in range(5)], poses, 200_000_000)[0])
        differences.append((poses[-1][:3, 3] - poses[-2][:3, 3]) / 0.05)
    assert np.std(fitted) < np.std(differences)


def test_two_poses_give_their_difference() -> None:
    poses = [np.eye(4), se3.from_rt(np.eye(3), np.array([0.1, 0.0, 0.0]))]
    np.testing.assert_allclose(end_rates([0, 50_000_000], poses, 50_000_000)[0], [2.0, 0.0, 0.0])


CAMERA = np.array([400.0, 410.0, 320.0, 240.0])


def test_rays_meet_where_the_pixels_came_from() -> None:
    rng = np.random.default_rng(3)
    n = 50
    points = rng.uniform([-2, -2, 4], [2, 2, 9], (n, 3))
    poses = [np.stack([se3.exp(np.array([0.3 * k, 0, 0, 0, 0.02 * k, 0.01])) for _ in range(n)]) for k in range(3)]
    cameras = np.tile(CAMERA, (n, 1))
    lines = []
    for T in poses:
        pixels, depth = project(points, cameras, T)
        assert (depth > 0).all()
        lines.append(rays(pixels, cameras, T))
    found, good = nearest_point(np.stack([o for o, _ in lines], 1), np.stack([d for _, d in lines], 1))
    assert good.all()
    assert np.allclose(found, points, atol=1e-8)
    cosine = parallax(lines[0][0], lines[2][0], points)
    a, b = points[0] - lines[0][0][0], points[0] - lines[2][0][0]
    assert np.isclose(cosine[0], a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def test_parallel_rays_are_said_to_meet_nowhere() -> None:
    direction = np.tile([0.0, 0.0, 1.0], (1, 2, 1))
    _, good = nearest_point(np.array([[[0.0, 0, 0], [1.0, 0, 0]]]), direction)
    assert not good[0]


numbers = arrays(np.float64, st.integers(1, 40), elements=st.floats(-1e6, 1e6, allow_subnormal=False))


@given(numbers)
def test_median(values: np.ndarray) -> None:
    assert median(values) == float(np.median(values))


@given(numbers, st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4))
def test_quantiles(values: np.ndarray, shares: list[float]) -> None:
    found = quantiles(values, tuple(shares))
    assert found == tuple(np.quantile(values, shares).tolist())

"""Rigid motions in Python's floats against the matrix exponential and numpy's linear algebra."""

import numpy as np
import pytest
from numpy.typing import NDArray

from kiteline_core.geometry import se3

F64 = NDArray[np.float64]


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

"""Kernels of the filter's covariance against plain numpy."""

import numpy as np

from kiteline_agent.ekf import covariance_kernels as kernels
from kiteline_core.arrays import F64, I64


def _covariance(n: int, seed: int = 0) -> tuple[F64, F64]:
    """A covariance, and its lower triangle with rubbish above, which no kernel may read."""
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n))
    full = a @ a.T + np.eye(n)
    return full, np.where(np.tri(n, dtype=bool), full, 777.0)


def _whole(P: F64) -> F64:
    return np.asarray(np.tril(P) + np.tril(P, -1).T)


def _observations(n: int, m: int, seed: int = 1) -> tuple[I64, F64, F64]:
    """First rows of m landmarks after a pose, their Jacobians (m,2,3), and the dense one (2m,n)."""
    rng = np.random.default_rng(seed)
    index = 7 + 3 * np.arange(m)
    M = rng.standard_normal((m, 2, 3))
    dense = np.zeros((2 * m, n))
    for k in range(m):
        dense[2 * k : 2 * k + 2, :3] = -M[k]
        dense[2 * k : 2 * k + 2, index[k] : index[k] + 3] = M[k]
    return index, M, dense


def test_products_are_added_to_the_lower_triangle() -> None:
    full, P = _covariance(22)
    for m, n in ((4, 20), (8, 12), (20, 4)):
        rows = np.random.default_rng(m).standard_normal((m, n))
        changed, expected = P.copy(), full.copy()
        kernels.add_products(changed, rows, -2.0)
        expected[:n, :n] -= 2.0 * rows.T @ rows
        np.testing.assert_allclose(_whole(changed), expected, atol=1e-12)


def test_rows_are_read_and_set() -> None:
    full, P = _covariance(12)
    out = np.empty((3, 12))
    kernels.symmetric_rows(P, 12, np.array([0, 5, 11]), out)
    np.testing.assert_array_equal(out, full[[0, 5, 11]])
    row = np.arange(12.0)
    kernels.set_row(P, 12, 5, row)
    full[5], full[:, 5] = row, row
    np.testing.assert_array_equal(_whole(P), full)


def test_innovation_of_landmarks_is_that_of_the_dense_jacobian() -> None:
    full, P = _covariance(22)
    index, M, dense = _observations(22, 5)
    S = np.empty((10, 10))
    kernels.innovation_covariance(P, index, M, 0.25, S)
    np.testing.assert_allclose(S, dense @ full @ dense.T + 0.25 * np.eye(10), atol=1e-10)


def test_set_without_a_gate_is_a_cholesky_factor_and_whitens() -> None:
    _, P = _covariance(22)
    index, M, _ = _observations(22, 5)
    S = np.empty((10, 10))
    kernels.innovation_covariance(P, index, M, 0.25, S)
    residual = np.random.default_rng(2).standard_normal(10)
    L, white, taken = np.zeros((10, 10)), np.zeros(10), np.zeros(5, np.int64)
    order = np.array([3, 0, 4, 1, 2])
    assert kernels.compatible_set(S, residual, order, np.inf, L, white, taken) == 5
    np.testing.assert_array_equal(taken, order)
    both = (2 * order[:, None] + [0, 1]).ravel()
    np.testing.assert_allclose(L.T @ L, S[np.ix_(both, both)], atol=1e-10)
    np.testing.assert_allclose(L.T @ white, residual[both], atol=1e-10)


def test_matches_are_taken_that_fit_given_those_before() -> None:
    a = np.random.default_rng(3).standard_normal((16, 16))
    S = a @ a.T + np.eye(16)
    residual = np.linalg.cholesky(S) @ np.random.default_rng(4).standard_normal(16)
    expected: list[int] = []
    for k in range(8):
        before = np.array([2 * j + c for j in expected for c in (0, 1)], np.int64)
        here = np.array([2 * k, 2 * k + 1])
        gain = np.linalg.solve(S[np.ix_(before, before)], S[np.ix_(before, here)]).T
        left = residual[here] - gain @ residual[before]
        spread = S[np.ix_(here, here)] - gain @ S[np.ix_(before, here)]
        if left @ np.linalg.solve(spread, left) <= 1.5:
            expected.append(k)
    L, white, taken = np.zeros((16, 16)), np.zeros(16), np.zeros(8, np.int64)
    count = kernels.compatible_set(S, residual, np.arange(8), 1.5, L, white, taken)
    assert taken[:count].tolist() == expected and 2 < count < 8


def test_match_that_contradicts_those_before_is_left_out() -> None:
    """Two errors that have one cause must agree, though each alone is likely."""
    S = 100.0 * np.ones((6, 6)) + np.eye(6)
    residual = np.array([9.0, 9.0, 9.5, 8.5, -9.0, 9.0])
    L, white, taken = np.zeros((6, 6)), np.zeros(6), np.zeros(3, np.int64)
    count = kernels.compatible_set(S, residual, np.array([0, 1, 2]), 10.6, L, white, taken)
    assert taken[:count].tolist() == [0, 1]

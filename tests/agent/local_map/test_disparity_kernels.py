"""The normal equations of a pair of frames with a disparity offset, against plain numpy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_agent.local_map import disparity_kernels as kernels
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.disparity_offset import terms
from tests.agent.disparity_flights import CAMERA, normalised


def intrinsics() -> F64:
    return np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.bf])


def residuals(uv: F64, disparity: F64, seen: F64, T: F64, offset: F64, rho: F64) -> F64:
    """(n,4) px: of the first disparity, then of u, v and disparity in the second frame; 0 if not measured."""
    q = np.column_stack([normalised(uv), np.ones(len(uv))]) @ T[:3, :3].T + rho[:, None] * T[:3, 3]
    found = q[:, :2] / q[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    far = CAMERA.bf * rho / q[:, 2] + terms(normalised(seen[:, :2])) @ offset - seen[:, 2]
    return np.column_stack([
        CAMERA.bf * rho + terms(normalised(uv)) @ offset - disparity, found - seen[:, :2],
        np.where(seen[:, 2] >= 0.0, far, 0.0),
    ])  # fmt: skip


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_normal_equations_are_those_of_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 12
    uv = rng.uniform([40, 40], [710, 440], (n, 2))
    rho, offset = rng.uniform(0.1, 0.6, n), rng.normal(0, 0.3, 5)
    T = se3.exp(rng.normal(0, 0.1, 6))
    found = residuals(uv, np.zeros(n), np.zeros((n, 3)), T, offset, rho)
    seen = np.column_stack([found[:, 1:3], CAMERA.bf * rho]) + rng.normal(0, 0.3, (n, 3))
    seen[::5, 2] = -1.0
    disparity, sigma = CAMERA.bf * rho + rng.normal(0, 0.3, n), rng.uniform(0.5, 1.0, n)

    def all_residuals(x: F64) -> F64:
        X = se3.exp(np.concatenate([np.zeros(3), x[3:6]])) @ T
        X[:3, 3] += x[:3]
        return (residuals(uv, disparity, seen, X, offset + x[6:11], rho + x[11:]) / sigma[:, None]).ravel()

    step = 1e-6
    jac = np.stack([(all_residuals(step * e) - all_residuals(-step * e)) / (2 * step) for e in np.eye(11 + n)], 1)
    e = all_residuals(np.zeros(11 + n)).reshape(n, 4)
    square = np.sum(e**2, 1)
    root = np.repeat(np.sqrt(np.where(square > 9.0, 9.0 / np.maximum(square, 1e-9), 1.0)), 4)
    jac, e_all = jac * root[:, None], e.ravel() * root
    h, b = jac.T @ jac, -jac.T @ e_all
    eliminate = np.linalg.solve(h[11:, 11:], h[11:, :11]).T
    system, point = np.empty((11, 12)), np.empty((n, 12))
    mean = kernels.linearise_pair(uv, disparity, sigma, seen, T, intrinsics(), offset, rho, system, point)
    want = h[:11, :11] - eliminate @ h[11:, :11]
    assert np.allclose(system[:, :11], want, rtol=1e-4, atol=1e-3 * np.abs(want).max())
    side = b[:11] - eliminate @ b[11:]
    assert np.allclose(system[:, 11], side, rtol=1e-4, atol=1e-3 * max(np.abs(side).max(), 1.0))
    assert mean == pytest.approx(float(np.minimum(square, 9.0).mean()))
    x = rng.normal(0, 1e-3, 11)
    moved = rho.copy()
    kernels.move_points(point, x, 1e-4, moved)
    assert np.allclose(moved - rho, np.linalg.solve(h[11:, 11:], b[11:] - h[11:, :11] @ x), rtol=1e-3, atol=1e-6)

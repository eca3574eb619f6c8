"""Segments and depths of landmarks without depth, against plain numpy."""

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.keyframes.seed_kernels import intersect, seed_segments
from kiteline_core.geometry import se3

F64 = NDArray[np.float64]
CAMERA = np.array([420.0, 430.0, 320.0, 200.0, 40.0])
KEYFRAMES, SLOT, N = 3, 12, 20


def poses(rng: np.random.Generator, n: int) -> F64:
    return np.stack([se3.exp(rng.normal(0.0, 0.2, 6)) for _ in range(n)])


def pixels(direction: F64, centre: F64, rho: F64) -> F64:
    p = direction + centre * rho[:, None]
    return np.asarray(p[:, :2] / np.maximum(p[:, 2], 0.05)[:, None] * CAMERA[:2] + CAMERA[2:4])


def test_segments_of_seeds() -> None:
    rng = np.random.default_rng(1)
    T_c_m, T_m_k = poses(rng, 1)[0], poses(rng, KEYFRAMES)
    bearing = rng.normal(0.0, 0.4, (KEYFRAMES, SLOT, 2))
    rows = rng.integers(0, KEYFRAMES * SLOT, N)
    rho, sigma = rng.uniform(0.05, 0.5, N), rng.uniform(0.01, 0.4, N)
    direction, centre = np.empty((2, N, 3))
    start, end = np.empty((2, N, 2))
    seed_segments(T_c_m, CAMERA, rows, T_m_k, bearing, rho, sigma, 2.0, 0.6, direction, centre, start, end)
    T_c_k = T_c_m @ T_m_k[rows // SLOT]
    ray = np.column_stack([bearing.reshape(-1, 2)[rows], np.ones(N)])
    assert np.allclose(direction, np.einsum("nij,nj->ni", T_c_k[:, :3, :3], ray))
    assert np.allclose(centre, T_c_k[:, :3, 3])
    assert np.allclose(start, pixels(direction, centre, np.maximum(rho - 2.0 * sigma, 1e-6)))
    assert np.allclose(end, pixels(direction, centre, np.minimum(rho + 2.0 * sigma, 0.6)))


def test_depths_where_rays_meet() -> None:
    rng = np.random.default_rng(2)
    direction, centre = rng.normal(0.0, 0.3, (N, 3)) + [0.0, 0.0, 1.0], rng.normal(0.0, 0.3, (N, 3))
    true = rng.uniform(0.1, 0.8, N)
    uv = pixels(direction, centre, true)
    octave = rng.integers(0, 3, N).astype(np.uint8)
    rho, variance, off = np.empty((3, N))
    intersect(direction, centre, uv, octave, CAMERA, 0.5, rho, variance, off)
    assert np.allclose(rho, true) and off.max() < 1e-6
    step = 1e-6  # px of a change of the inverse depth, by differences
    slope = np.linalg.norm(pixels(direction, centre, true + step) - pixels(direction, centre, true - step), axis=1)
    expected = (0.5 * (1 << octave.astype(np.int64)) / (slope / (2.0 * step))) ** 2
    in_front = direction[:, 2] + centre[:, 2] * true > 0.05
    assert in_front.sum() > N // 2 and np.allclose(variance[in_front], expected[in_front], rtol=1e-4)
    along = pixels(direction, centre, true + 0.1) - uv
    across = np.column_stack([-along[:, 1], along[:, 0]])
    across *= 3.0 / np.linalg.norm(across, axis=1)[:, None]
    intersect(direction, centre, uv + across, octave, CAMERA, 0.5, rho, variance, off)
    assert np.allclose(off, 3.0, rtol=0.01)
    intersect(-direction, 0.0 * centre, uv, octave, CAMERA, 0.5, rho, variance, off)
    assert np.isinf(variance).all()

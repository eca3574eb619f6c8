"""Uncertainty of a map that grows keyframe by keyframe."""

from __future__ import annotations

import numpy as np

from kiteline_agent.map_drift import MapDrift
from kiteline_core import se3
from kiteline_core.ids import KeyframeId

KEYS = [KeyframeId(k) for k in range(100, 112)]
INFORMATION = np.diag([4e6, 4e6, 1e6, 4e7, 4e7, 4e7])


def seen(key: KeyframeId) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.full(50, key, np.int64)


def test_a_chain_of_noisy_keyframes_errs_as_it_says() -> None:
    rng = np.random.default_rng(0)
    step = se3.exp(np.array([0.0, 0.0, 0.5, 0.0, 0.15, 0.0]))
    T_b = step @ step
    sigma = np.sqrt(1.0 / np.diag(INFORMATION))
    drift = MapDrift(1.0, 100)
    drift.begin(KEYS[0])
    true = [np.eye(4)]
    for k in range(1, 11):
        true.append(true[-1] @ step)
        drift.add(KEYS[k], seen(KEYS[k - 1]), true[-1], INFORMATION)
    cov = drift.pose_cov(seen(KEYS[10]), true[-1] @ T_b, np.zeros((6, 6)))
    nees = []
    for _ in range(300):
        T = np.eye(4)
        for _ in range(10):
            # T_k_m errs by a perturbation on its left
            T = T @ step @ se3.exp(-sigma * rng.normal(size=6))
        good, bad = true[-1] @ T_b, T @ T_b
        e = np.concatenate([good[:3, 3] - bad[:3, 3], se3.so3_log(bad[:3, :3].T @ good[:3, :3])])
        nees.append(e @ np.linalg.solve(cov, e))
    assert 5.2 < np.mean(nees) < 6.9  # 6 degrees of freedom


def test_coming_back_is_being_certain_again() -> None:
    drift = MapDrift(4.0, 100)
    drift.begin(KEYS[0])
    for k in range(1, 6):
        drift.add(KEYS[k], seen(KEYS[k - 1]), np.eye(4), INFORMATION)
    local = 1e-6 * np.eye(6)
    far = drift.pose_cov(seen(KEYS[5]), np.eye(4), local)
    np.testing.assert_allclose(far, local + 20.0 * np.linalg.inv(INFORMATION), rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(drift.pose_cov(seen(KEYS[0]), np.eye(4), local), local)
    drift.refine(KEYS[5], 0.25)
    better = drift.pose_cov(seen(KEYS[5]), np.eye(4), local)
    np.testing.assert_allclose(better, local + 5.0 * np.linalg.inv(INFORMATION), rtol=1e-3, atol=1e-12)


def test_memory_is_bounded_and_the_forgotten_count_as_the_oldest() -> None:
    drift = MapDrift(1.0, 3)
    assert not drift.pose_cov(seen(KEYS[0]), np.eye(4), np.zeros((6, 6))).any()
    drift.begin(KEYS[0])
    for k in range(1, 8):
        drift.add(KEYS[k], seen(KEYS[k - 1]), np.eye(4), INFORMATION)
    oldest = drift.pose_cov(seen(KEYS[5]), np.eye(4), np.zeros((6, 6)))
    np.testing.assert_array_equal(drift.pose_cov(seen(KEYS[0]), np.eye(4), np.zeros((6, 6))), oldest)
    assert oldest[0, 0] > 0.0

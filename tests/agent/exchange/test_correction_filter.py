"""How much of a correction of the live pose is taken over, by the deviation that the base tells."""

import numpy as np
import pytest

from kiteline_agent.config import SmoothingConfig
from kiteline_agent.exchange.correction_filter import CorrectionFilter
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3

CONFIG = SmoothingConfig()
HERE = np.array([4.0, 0.0, 1.0])


def scaled(scale: float) -> F64:
    """T_w_o of a map that is `scale` times as long in w."""
    return sim3.of(scale, np.eye(4))


def place(T_w_o: F64, here_o: F64) -> F64:
    return np.asarray(se3.transform(T_w_o, here_o[None])[0])


def test_without_a_deviation_every_correction_is_taken_over_as_it_is() -> None:
    weights = CorrectionFilter(CONFIG)
    for scale in (1.0, 1.03, 0.98):
        assert weights.weigh(scaled(scale), HERE, 0.0) is not None
        assert np.array_equal(weights.weigh(scaled(scale), HERE, 0.0), scaled(scale))


def test_a_first_scale_counts_by_its_deviation_beside_that_of_the_agent() -> None:
    moved = {}
    for sigma in (0.001, CONFIG.scale_sigma, 0.3):
        weights = CorrectionFilter(CONFIG)
        weights.weigh(scaled(1.0), HERE, 0.0)
        moved[sigma] = float(np.linalg.norm(place(weights.weigh(scaled(1.02), HERE, sigma), HERE) - HERE))
    whole = 0.02 * float(np.linalg.norm(HERE))
    assert moved[0.001] == pytest.approx(whole, rel=0.01)
    assert moved[CONFIG.scale_sigma] == pytest.approx(0.5 * whole, rel=0.01)
    assert moved[0.3] == pytest.approx(0.01 * whole, rel=0.05)


def test_equally_uncertain_scales_are_averaged() -> None:
    """That of the agent and two of the base, at the same place: each counts a third."""
    weights = CorrectionFilter(CONFIG)
    weights.weigh(scaled(1.0), HERE, 0.0)
    weights.weigh(scaled(1.02), HERE, CONFIG.scale_sigma)
    told = place(weights.weigh(scaled(0.985), HERE, CONFIG.scale_sigma), HERE)
    assert np.allclose(told, (1.0 + 1.02 + 0.985) / 3.0 * HERE, atol=6e-4 * np.linalg.norm(HERE))


def test_a_relocalisation_is_no_correction() -> None:
    weights, T_o_n = CorrectionFilter(CONFIG), se3.from_rt(np.eye(3), np.array([0.5, -0.3, 0.1]))
    weights.weigh(scaled(1.0), HERE, 0.0)
    withheld = scaled(1.02) - weights.weigh(scaled(1.02), HERE, 0.02)
    weights.move_odometry(T_o_n)
    assert withheld.any()
    assert np.allclose(weights.weigh(scaled(1.02) @ T_o_n, HERE, 0.02), scaled(1.02) @ T_o_n - withheld)


def test_lengths_from_now_on_are_those_that_the_base_tells() -> None:
    weights = CorrectionFilter(CONFIG)
    weights.weigh(scaled(1.0), HERE, 0.0)
    told = weights.weigh(scaled(1.02), HERE, 0.01)
    ahead = HERE + np.array([0.0, 1.0, 0.0])
    assert np.allclose(place(weights.weigh(scaled(1.02), ahead, 0.01), ahead) - place(told, HERE), [0.0, 1.02, 0.0])


def test_scales_that_scatter_move_the_vehicle_less_than_each_of_them() -> None:
    """Scales of one deviation, told once a second to a vehicle that flies on: their mean is nearer to the truth."""
    rng = np.random.default_rng(4)
    by_filter, by_each = [], []
    for _ in range(40):
        weights, here = CorrectionFilter(CONFIG), HERE.copy()
        weights.weigh(scaled(1.0), here, 0.0)
        for _ in range(12):
            here = here + np.array([0.3, 0.2, 0.0])
            T_w_o = scaled(1.0 + 0.01 * rng.normal())
            told = weights.weigh(T_w_o, here, 0.01)
        by_filter.append(place(told, here) - here)
        by_each.append(place(T_w_o, here) - here)
    assert np.std(by_filter) < 0.6 * np.std(by_each)


def test_a_merge_is_taken_over_whole() -> None:
    weights = CorrectionFilter(CONFIG)
    weights.weigh(scaled(1.0), HERE, 0.0)
    weights.weigh(scaled(1.02), HERE, 0.02)
    far = se3.from_rt(np.eye(3), np.array([CONFIG.snap_m + 1.0, 0.0, 0.0]))
    assert np.array_equal(weights.weigh(far, HERE, 0.02), far)
    weights.weigh(scaled(1.02), HERE, 0.02)
    weights.clear()
    assert np.array_equal(weights.weigh(scaled(0.99), HERE, 0.02), scaled(0.99))

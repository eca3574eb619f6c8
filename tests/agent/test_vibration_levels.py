"""How much an accelerometer vibrates in each interval of a window."""

import numpy as np
import pytest

from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.initialisation.vibration_levels import vibration


def intervals(deviations: list[float], every: int = 1) -> list[Samples]:
    """Intervals of 0.25 s at 200 Hz whose acceleration swings slowly, with white noise of these deviations, m/s^2."""
    rng, t_s = np.random.default_rng(3), np.linspace(0.0, 0.25, 51)[::every]
    swing = np.sin(6.0 * t_s)[:, None] * [2.0, 1.0, 0.5]
    return [
        Samples(t_s, np.zeros((len(t_s), 3)), swing + deviation * rng.standard_normal((len(t_s), 3)))
        for deviation in deviations
    ]


def test_levels_are_the_noise_of_each_interval_over_the_mean_of_all() -> None:
    true = [0.2] * 8 + [1.5] * 12
    mean = float(np.sqrt(np.mean(np.square(true))))
    found = vibration(intervals(true))
    assert found.density == pytest.approx(mean * np.sqrt(0.005), rel=0.1)
    apart = np.r_[0:6, 10:20]  # from the change, about which they are averaged
    np.testing.assert_allclose((found.levels * mean)[apart], np.array(true)[apart], rtol=0.15)
    assert found.level_now == pytest.approx(1.5 / mean, rel=0.1)


def test_intervals_with_few_samples_count_as_the_others() -> None:
    found = vibration([*intervals([1.0] * 4), *intervals([9.0], every=10)])
    np.testing.assert_allclose(found.levels, 1.0, atol=0.1)
    alone = vibration(intervals([1.0, 2.0], every=10))
    assert alone.density == 0.0 and (alone.levels == 1.0).all()


def test_motion_without_noise_is_no_vibration() -> None:
    assert vibration(intervals([0.0] * 3)).density < 1e-4

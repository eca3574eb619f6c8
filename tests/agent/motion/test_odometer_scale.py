"""Of one camera's map the odometer tells how much it has grown; of others, the map tells the odometer's scale."""

import numpy as np
import pytest

from kiteline_agent.motion.odometer_scale import OdometerScale

DT_S = 0.2
NOISE_M_S = 0.05


def driven(scale: OdometerScale, seconds: float, growth: float = 1.0, noise: float = 0.0, seed: int = 0) -> None:
    """Windows at 0.8 m/s in changing directions, seen by images as so many times as long."""
    rng = np.random.default_rng(seed)
    for k in range(round(seconds / DT_S)):
        moved = 0.8 * DT_S * np.array([np.cos(0.3 * k), np.sin(0.3 * k), 0.1])
        scale.add(moved + noise * rng.normal(size=3), growth * moved, DT_S, NOISE_M_S)


def test_a_map_that_grew_is_to_be_scaled_back() -> None:
    scale = OdometerScale(of_map=True)
    driven(scale, 6.0)
    assert scale.correction(believed=True) is None
    driven(scale, 20.0, 1.06, noise=0.004)
    found = scale.correction(believed=True)
    assert found is not None
    factor, sigma = found
    assert factor == pytest.approx(1.0 / 1.06, abs=3.0 * sigma) and sigma < 0.025
    scale.begin(factor)
    assert scale.value == pytest.approx(1.0) and scale.correction(believed=True) is None


def test_corrections_are_some_time_apart() -> None:
    scale = OdometerScale(of_map=True)
    driven(scale, 20.0, 1.06)
    scale.begin(0.98)
    driven(scale, 3.8, 1.04)
    assert scale.correction(believed=True) is None
    scale.scale_map(1.0)  # the base's corrections, several times a second, do not hold it up
    driven(scale, 0.4, 1.04)
    assert scale.correction(believed=True) is not None


def test_where_images_measure_lengths_the_odometer_is_off() -> None:
    scale = OdometerScale(of_map=False)
    driven(scale, 20.0, 1.06)
    assert scale.value == pytest.approx(1.06, abs=0.005) and scale.correction(believed=True) is None
    scale.scale_map(0.5)
    assert scale.value == pytest.approx(1.06, abs=0.005)


def test_a_slip_does_not_scale_the_map() -> None:
    scale = OdometerScale(of_map=True)
    driven(scale, 10.0)
    driven(scale, 2.0, 0.4)  # wheels that spin measure more than was driven
    assert scale.correction(believed=True) is None and scale.value == pytest.approx(1.0, abs=0.01)

"""A length that an odometer tells moves a window's scale as far as both deviations say."""

import numpy as np
import pytest

from kiteline_agent.initialisation.window.inertial_terms import STATE
from kiteline_agent.initialisation.window.known_length import KnownLength, extent, joint_sigma
from kiteline_agent.initialisation.window.window_bundle import InertialBundle
from kiteline_agent.initialisation.window.window_state import WarmStart
from tests.agent.initialisation.window.test_window_bundle import (
    CALIBRATION,
    CONFIG,
    FOCAL,
    PRIOR,
    T_B_C,
    bundle,
    scale_of,
    window,
)


def test_normal_equations_are_those_of_the_cost() -> None:
    rng, size = np.random.default_rng(0), 5 * STATE
    p = rng.normal(size=(5, 3))
    known = KnownLength(0.9 * extent(p), 0.02)
    rows = (STATE * np.arange(5)[:, None] + np.arange(3, 6)).ravel()
    h, b = np.zeros((size, size)), np.zeros(size)
    assert known.add(p, rows, h, b) == known.cost(p) > 0.0
    for k in range(15):
        step = np.zeros(15)
        step[k] = 1e-6
        slope = (known.cost(p + step.reshape(5, 3)) - known.cost(p - step.reshape(5, 3))) / 2e-6
        assert b[rows[k]] == pytest.approx(slope, rel=1e-5, abs=1e-6)
    along = np.zeros(size)
    along[rows] = (p - p.mean(axis=0)).ravel()  # all lengths grow
    assert along @ h @ along == pytest.approx(0.02**-2)


@pytest.mark.parametrize("seed", range(3))
def test_a_short_window_is_as_long_as_an_odometer_says(seed: int) -> None:
    corners, cut, truth = window(seed, keyframes=9)
    alone = bundle(corners, cut)
    found = alone.solve()
    assert found is not None and found.scale_sigma > 0.02
    known = KnownLength(extent(truth[:, :3, 3]), 0.01)
    together = InertialBundle(corners, cut, CALIBRATION, T_B_C, FOCAL, 9.81, PRIOR, CONFIG, length=known)
    both = together.solve(WarmStart(found.state, alone.landmarks_of(found.state)[0]))
    assert both is not None
    assert both.scale_sigma == pytest.approx(joint_sigma(found.scale_sigma, known), rel=0.2)
    assert abs(np.log(scale_of(both, truth))) < min(0.015, abs(np.log(scale_of(found, truth))) + 0.005)

"""What an odometer is worth where no image shows a manoeuvre."""

import numpy as np
import pytest

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from tests.agent.motion import test_odometer as flights


def darting(t_s: float) -> F64:
    """A body that begins to speed up at 4.5 s, within 0.2 s to 11 m/s^2, and turns meanwhile."""
    t, jerk, ramp = max(t_s - 4.5, 0.0), 55.0, 0.2
    held = max(t - ramp, 0.0)
    ramped = min(t, ramp)
    x = 1.0 * t_s + jerk * ramped**3 / 6.0 + jerk * ramped**2 / 2.0 * held + jerk * ramped * held**2 / 2.0
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, 1.5 * t])), np.array([x, 0.0, 1.0]))


def test_a_vehicle_that_darts_in_the_dark_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "body_at", darting)
    flights.true_twists.cache_clear()
    try:
        flown = flights.Flown(flights.driven(5.0), 5.0, blind_from_s=4.0)
        assert np.linalg.norm(flown.error(5.0)[:3]) < 0.1 and np.linalg.norm(flown.error(5.0)[3:]) < 0.05
        assert flown.odometer.used
    finally:
        flights.true_twists.cache_clear()

"""Biases that may follow a calibration while it changes, and for a second after it."""

import numpy as np
import pytest

from kiteline_agent.inertial.bias_relaxation import BiasRelaxation


@pytest.mark.parametrize("what", [0, 1, 2])
@pytest.mark.parametrize("rate_hz", [10.0, 120.0])
def test_biases_are_free_while_what_is_applied_changes_and_a_second_longer(what: int, rate_hz: float) -> None:
    watch, dt_s = BiasRelaxation(), 1.0 / rate_hz
    free_s = []
    for k in range(round(4.0 * rate_hz)):
        along = min(max(k * dt_s - 1.0, 0.0), 0.5)  # it changes from 1 to 1.5 s
        by = [0.02 * along if sensor == what else 0.0 for sensor in range(3)]
        if watch.walk(by[0], np.eye(3) + by[1], np.eye(3) + by[2], dt_s).any():
            free_s.append(k * dt_s)
    assert free_s[0] == pytest.approx(1.0, abs=2.0 * dt_s)
    assert free_s[-1] == pytest.approx(2.5, abs=2.0 * dt_s)
    assert len(free_s) == round((free_s[-1] - free_s[0]) * rate_hz) + 1


def test_slow_changes_leave_them_as_they_are() -> None:
    watch = BiasRelaxation()
    assert not any(watch.walk(1e-3 * 0.05 * k, np.eye(3), np.eye(3), 0.05).any() for k in range(100))

"""An odometer tells how long the path of a window of images and IMU is."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.initialisation.window.known_length import extent
from kiteline_agent.initialisation.window_odometry import WindowOdometry
from kiteline_agent.motion.odometer_samples import MeanVelocity
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

DT_NS, KEYFRAMES = 240_000_000, 15
TWIST = np.array([0.6, 0.1, -0.05, 0.1, -0.2, 0.5])  # m/s, rad/s, of the body


def path() -> F64:
    """(K,4,4) of a body that flies a curve."""
    return np.array([se3.exp(1e-9 * DT_NS * k * TWIST) for k in range(KEYFRAMES)])


def told(longer: float, sigma: float = 0.1, missing: int = -1, cov: F64 | None = None) -> Any:
    """What an odometer with true lengths says of a window that is so many times as long. missing: a step."""
    velocity_cov = 1e-3 * np.eye(3) if cov is None else cov

    def mean(from_ns: int, _to_ns: int) -> MeanVelocity | None:
        known = MeanVelocity(TWIST[:3], TWIST[3:], velocity_cov, np.eye(3))
        return None if from_ns == missing * DT_NS else known

    odometry, true = WindowOdometry(mean), path()
    for k in range(KEYFRAMES):
        odometry.add(k * DT_NS)
    state: Any = SimpleNamespace(R=true[:, :3, :3], p=longer * true[:, :3, 3])
    length = odometry.length(tuple(DT_NS * k for k in range(KEYFRAMES)), state, sigma)
    return length, odometry.take_events(), extent(true[:, :3, 3])


@pytest.mark.parametrize("longer", [1.0, 0.9, 1.2])
@pytest.mark.parametrize("missing", [-1, 5])
def test_the_path_is_as_long_as_the_odometer_says(longer: float, missing: int) -> None:
    length, events, true_m = told(longer, missing=missing)
    assert length.metres == pytest.approx(true_m, rel=2e-3) and 0.01 <= length.sigma < 0.015 and not events


def test_an_odometer_of_one_axis_tells_it_too() -> None:
    length, _, true_m = told(1.1, cov=np.diag([1e-3, 1e6, 1e6]))
    assert length.metres == pytest.approx(true_m, rel=0.01)


def test_one_that_contradicts_the_imu_tells_nothing_and_says_so() -> None:
    length, (event,), _ = told(0.8, sigma=0.02)
    assert length is None and "25 % too long" in event

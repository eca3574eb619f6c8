"""Rotations by images that scatter against the gyro: people who drag the map must not pass for a worn IMU."""

import numpy as np
import pytest

from kiteline_agent.inertial.calibration import self_calibration
from kiteline_agent.inertial.calibration.pose_chain import PoseChain, SampledMotion
from kiteline_agent.inertial.calibration.turn_scatter import added_variance
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch
from kiteline_core.geometry import se3
from tests.agent.inertial.calibration.test_imu_self_calibration import (
    CALIBRATION,
    GYRO,
    Flight,
    applied,
    calibrated,
    flight,
)

IMAGE_RAD = 4e-4


def dragged(f: Flight, frames: slice, step_rad: float, seed: int) -> Flight:
    """The flight in a map that is turned by step_rad more about each axis in each of these frames."""
    steps = np.zeros((len(f.t_ns), 3))
    steps[frames] = step_rad * np.random.default_rng([seed, 11]).normal(size=steps[frames].shape)
    turns = np.cumsum(steps, axis=0)
    moved = [se3.from_rt(se3.so3_exp(w), 2.0 * w) @ T for T, w in zip(f.seen, turns, strict=True)]
    return Flight(f.t_ns, np.array(moved), f.truth, f.samples)


def added(f: Flight, matrix: F64, bias: F64) -> list[float]:
    """What each window of a flight is given."""
    buffer, chain, done, out = SampleBuffer(3.0, 0.2), PoseChain(0.25), 0, []
    for t_ns, T in zip(f.t_ns, f.seen, strict=True):
        end = int(np.searchsorted(f.samples.t_ns, t_ns, "right"))
        buffer.push(ImuBatch(f.samples.t_ns[done:end], f.samples.gyro[done:end], f.samples.accel[done:end]))
        done = end
        chain.add(int(t_ns), T)
        link = chain.take(buffer, 0.0)
        if isinstance(link, SampledMotion):
            out.append(added_variance(link, buffer, matrix, bias, IMAGE_RAD, CALIBRATION.gyro_noise))
    return out


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("gyro", [None, GYRO], ids=["true axes", "worn axes"])
@pytest.mark.parametrize("late_ns", [0, 15_000_000])
def test_bias_offset_and_worn_axes_are_no_scatter(seed: int, gyro: F64 | None, late_ns: int) -> None:
    f = flight(12.0, seed, gyro=gyro, late_ns=late_ns)
    found = added(f, np.eye(3), np.array([0.05, -0.05, 0.05]))
    assert len(found) > 30
    assert np.count_nonzero(found) <= 0.05 * len(found)


def test_errors_that_add_up_are_found_in_their_size() -> None:
    f = dragged(flight(12.0), slice(None), 5e-3, 0)
    found, expected = float(np.mean(added(f, np.eye(3), np.zeros(3)))), 5 * 5e-3**2
    assert 0.7 * expected < found < 1.4 * expected


@pytest.mark.parametrize("seed", range(4))
def test_a_map_that_is_dragged_at_the_start_is_no_worn_imu(seed: int) -> None:
    calibration = calibrated(dragged(flight(8.0, seed), slice(0, 20), 4e-3, seed))
    gyro, accel = applied(calibration)
    np.testing.assert_array_equal(gyro, np.eye(3))
    np.testing.assert_array_equal(accel, np.eye(3))
    assert abs(calibration.offset_s) < 2e-3


def test_without_it_the_same_flights_would_be_corrected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_calibration, "added_variance", lambda *_: 0.0)
    found = [calibrated(dragged(flight(8.0, seed), slice(0, 20), 4e-3, seed)) for seed in range(4)]
    assert sum(not np.array_equal(applied(c)[0], np.eye(3)) for c in found) >= 3


def test_a_worn_imu_is_found_after_people_have_left() -> None:
    calibration = calibrated(dragged(flight(16.0, gyro=GYRO), slice(0, 20), 4e-3, 0))
    assert np.abs(applied(calibration)[0] @ GYRO - np.eye(3)).max() < 4e-3

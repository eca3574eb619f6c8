"""Samples that no motion explains are left out; motion, vibration and coarse sensors are not taken for them."""

import numpy as np
import pytest

from kiteline_agent.inertial.samples.sample_check import SampleCheck
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import ImuBatch

N, PERIOD_NS = 2000, 5_000_000
SIZES = (1, 2, 7, 10, 500)  # of batches


def motion(seed: int = 0) -> F64:
    """Rates and forces (N,6) of a flight, with an IMU's noise."""
    rng, t = np.random.default_rng(seed), 0.005 * np.arange(N)
    smooth = np.stack([np.sin((0.7 + 0.3 * axis) * t + axis) for axis in range(6)], axis=1)
    noise = np.repeat([0.01, 0.3], 3) * rng.standard_normal((N, 6))
    gravity = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.8])
    return np.asarray(np.repeat([1.0, 3.0], 3) * smooth + noise + gravity)


def kept(values: F64, size: int, check: SampleCheck | None = None) -> I64:
    """Numbers of the samples that are kept; each is kept once, in order."""
    check = check or SampleCheck()
    stamps = PERIOD_NS * np.arange(len(values), dtype=np.int64)
    out = []
    for k in range(0, len(values), size):
        part = slice(k, k + size)
        batch = check.checked(ImuBatch(stamps[part], values[part, :3], values[part, 3:]))
        if batch is not None:
            numbers = batch.t_ns // PERIOD_NS
            assert (values[numbers, :3] == batch.gyro).all() and (values[numbers, 3:] == batch.accel).all()
            out.append(numbers)
    found = np.concatenate(out)
    assert (np.diff(found) > 0).all()
    return np.asarray(found, np.int64)


def left_out(values: F64, size: int) -> set[int]:
    """Numbers of the samples that are left out; the last one may still wait."""
    return set(range(len(values) - 1)) - set(kept(values, size).tolist())


@pytest.mark.parametrize("size", SIZES)
def test_single_peaks_are_left_out_and_nothing_else(size: int) -> None:
    rng, values = np.random.default_rng(5), motion()
    at = np.arange(80, N - 5, 23)
    for k in at.tolist():
        axis = int(rng.integers(6))
        values[k, axis] += (8.0 if axis < 3 else 60.0) * rng.choice([-1.0, 1.0])
    assert left_out(values, size) == set(at.tolist())


@pytest.mark.parametrize("size", SIZES)
def test_a_step_of_the_motion_is_kept(size: int) -> None:
    values = motion()
    values[1000:, 0] += 6.0
    values[1001:1400, 4] -= 30.0
    assert left_out(values, size) == set()


def test_a_sample_that_may_be_a_peak_comes_with_the_next_one() -> None:
    values = motion()
    values[1000:, 0] += 6.0
    check = SampleCheck()
    assert 999 in kept(values[:1001], 7, check) and 1000 not in kept(values[:1001], 7)
    more = check.checked(ImuBatch(np.array([1001 * PERIOD_NS]), values[1001:1002, :3], values[1001:1002, 3:]))
    assert more is not None and (more.t_ns // PERIOD_NS).tolist() == [1000, 1001]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("hertz", [23.0, 67.0, 87.0, 100.0])
def test_vibration_that_comes_and_goes_is_kept(size: int, hertz: float) -> None:
    values, t = motion(), 0.005 * np.arange(N)
    strength = np.clip(np.sin(2.0 * np.pi * 0.7 * t), 0.0, None) ** 2
    values[:, 3:] += 30.0 * (strength * np.sin(2.0 * np.pi * hertz * t + 1.0))[:, None]
    values[:, :3] += 0.5 * (strength * np.cos(2.0 * np.pi * hertz * t))[:, None]
    assert left_out(values, size) == set()


@pytest.mark.parametrize("size", SIZES)
def test_what_a_stuck_bus_repeats_and_zeros_are_left_out(size: int) -> None:
    values = motion()
    values[1000:1012] = values[1000]
    values[[300, 1500]] = 0.0
    assert left_out(values, size) == {300, 1500, *range(1001, 1012)}


@pytest.mark.parametrize("size", SIZES)
def test_a_vehicle_at_rest_and_a_sensor_read_too_often_are_kept(size: int) -> None:
    rest = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.8], (N, 1))
    for times in (2, 4):
        assert left_out(np.repeat(motion()[: N // times], times, axis=0), size) == set()
    assert left_out(rest, size) == set()


@pytest.mark.parametrize("size", SIZES)
def test_a_coarse_sensor_leaves_no_gap(size: int) -> None:
    step = np.repeat([0.1, 1.0], 3)
    assert np.diff(kept(np.round(motion() / step) * step + 0.01, size)).max() <= 5


@pytest.mark.parametrize("size", SIZES)
def test_a_vehicle_that_comes_to_rest_is_kept_and_a_bus_that_stays_stuck_is_not(size: int) -> None:
    lands, stuck = motion(), motion()
    lands[1000:] = [0.01, -0.02, 0.0, 0.1, 0.0, 9.8]
    stuck[1000:] = stuck[1000]
    assert left_out(lands, size) == set()
    assert left_out(stuck, size) == set(range(1001, N - 1))
    back = motion()
    back[1000:1300] = back[1000]
    assert left_out(back, size) == set(range(1001, 1300))


@pytest.mark.parametrize("size", SIZES)
def test_a_peak_beside_other_wrong_samples_is_left_out(size: int) -> None:
    values = motion()
    values[600, 5] += 40.0
    values[601] = 0.0
    values[900, 1] -= 9.0
    values[901] = values[900]  # read twice
    assert left_out(values, size) == {600, 601, 900, 901}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("zeros", [1, 31, 40, 69])
def test_a_sensor_that_begins_with_zeros(size: int, zeros: int) -> None:
    values = motion()
    values[:zeros] = 0.0
    assert left_out(values, size) == set(range(zeros))


def test_what_is_not_finite_is_left_out() -> None:
    values = motion()
    values[500, 2], values[700, 4] = np.nan, np.inf
    assert left_out(values, 10) == {500, 700}


def test_few_wrong_samples_in_a_long_flight_are_not_told() -> None:
    values, check = np.tile(motion(), (10, 1)), SampleCheck()
    values[400:15_000:700, 3] += 60.0
    kept(values, 10, check)
    assert check.take_events() == []


def test_the_user_is_told_once() -> None:
    values, check = motion(), SampleCheck()
    values[600:1800:20, 3] += 50.0
    kept(values, 10, check)
    events = check.take_events()
    assert len(events) == 1 and "left out" in events[0]
    kept(values, 10, check)
    assert check.take_events() == []


def test_no_samples_are_no_fault() -> None:
    none = ImuBatch(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    assert SampleCheck().checked(None) is None and SampleCheck().checked(none) is none

"""The buffer of inertial samples: noise, holes, clipping, and levels of vibration."""

import numpy as np
import pytest

from kiteline_agent.inertial import imu_kernels
from kiteline_agent.inertial.preintegration import Samples, preintegrate
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer, without_held
from kiteline_agent.initialisation.window.window_noise import vibration
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, ImuCalibration

STEP_NS = 5_000_000
CALIBRATION = ImuCalibration()


def lively(n: int, noise: float = 0.0, seed: int = 0) -> tuple[F64, F64]:
    """Gyro and accelerometer (n,3) of a lively motion; noise: factor on the densities of the calibration."""
    rng = np.random.default_rng(seed)
    t = np.arange(n)[:, None] * STEP_NS * 1e-9
    root = noise * np.sqrt(CALIBRATION.rate_hz)
    gyro = 1.5 * np.sin(t * [3.0, 5.0, 4.0]) + root * CALIBRATION.gyro_noise * rng.normal(size=(n, 3))
    accel = (
        [0.0, 0.0, 9.8] + 3.0 * np.sin(t * [4.0, 6.0, 5.0]) + root * CALIBRATION.accel_noise * rng.normal(size=(n, 3))
    )
    return gyro, accel


def filled(gyro: F64, accel: F64, without: slice = slice(0)) -> SampleBuffer:
    """A buffer that was given the samples ten by ten, without some of them."""
    buffer = SampleBuffer(10.0, 0.2)
    stamps = np.arange(len(gyro), dtype=np.int64) * STEP_NS
    kept = np.ones(len(gyro), np.bool_)
    kept[without] = False
    for k in range(0, len(gyro), 10):
        some = np.arange(k, min(k + 10, len(gyro)))[kept[k : k + 10]]
        buffer.push(ImuBatch(stamps[some], gyro[some], accel[some]))
    return buffer


def interval(buffer: SampleBuffer, begin: int, end: int) -> Samples:
    samples = buffer.between(begin * STEP_NS, end * STEP_NS)
    assert samples is not None
    return samples


def test_second_differences_agree_with_a_plain_reference() -> None:
    rng = np.random.default_rng(4)
    t_ns = np.cumsum(rng.choice([5, 5, 5, 5, 5, 5, 6, 9, 30], 300)).astype(np.int64)
    values, sums = rng.normal(size=(300, 6)), np.empty((2, 2))
    counts = imu_kernels.second_differences(t_ns, values, 5.0, 1.5, 2.5, sums)
    dt = np.diff(t_ns)
    longest = np.maximum(dt[1:], dt[:-1])
    even = (longest <= 1.5 * np.minimum(dt[1:], dt[:-1])) & (longest <= 12.5)
    single = (values[2:] - 2.0 * values[1:-1] + values[:-2])[even]
    means = 0.5 * (values[1:] + values[:-1])
    double = (means[4:] - 2.0 * means[2:-2] + means[:-4])[np.lib.stride_tricks.sliding_window_view(even, 4).all(1)]
    assert counts == (len(single), len(double)) and len(double) > 20
    for found, bent, variance in zip(sums, (single, double), (6.0, 3.0), strict=True):
        np.testing.assert_allclose(found, (bent.reshape(-1, 2, 3) ** 2).mean(axis=2).sum(axis=0) / variance)


@pytest.mark.parametrize("factor", [1.0, 10.0, 40.0])
def test_noise_is_measured_in_motion(factor: float) -> None:
    buffer = filled(*lively(600, factor))
    np.testing.assert_allclose(
        buffer.density, factor * np.array([CALIBRATION.gyro_noise, CALIBRATION.accel_noise]), rtol=0.25
    )


def test_motion_is_no_noise() -> None:
    assert (filled(*lively(600)).density < 0.3 * np.array([CALIBRATION.gyro_noise, CALIBRATION.accel_noise])).all()


def test_noise_that_begins_is_believed_at_once_and_forgotten_when_it_ends() -> None:
    quiet, loud = lively(400, 1.0), lively(400, 20.0)
    both = [np.concatenate([q[:200], v[200:220], q[220:]]) for q, v in zip(quiet, loud, strict=True)]
    begun = filled(both[0][:220], both[1][:220]).density
    assert (begun > 10.0 * np.array([CALIBRATION.gyro_noise, CALIBRATION.accel_noise])).all()
    assert (filled(both[0], both[1]).density < 0.5 * begun).all()


def test_a_noisy_interval_has_a_larger_covariance_and_a_quiet_one_that_of_the_calibration() -> None:
    quiet, loud = (interval(filled(*lively(400, factor)), 300, 310) for factor in (1.0, 20.0))
    told, low, high = (
        preintegrate(s, np.zeros(6), CALIBRATION, 3.0).cov
        for s in (Samples(quiet.t_s, quiet.gyro, quiet.accel), quiet, loud)
    )
    np.testing.assert_array_equal(told, low)
    assert (np.diag(high) > 10.0 * np.diag(told)).all()


def test_missing_samples_are_interpolated_with_a_larger_covariance() -> None:
    gyro, accel = lively(400, 1.0)
    whole, holed = filled(gyro, accel), filled(gyro, accel, slice(300, 310))
    true, found = (preintegrate(interval(b, 295, 315), np.zeros(6), CALIBRATION) for b in (whole, holed))
    error = found.vp - true.vp
    assert (np.diag(found.cov) > 100.0 * np.diag(true.cov)).all()
    assert (error**2 < 9.0 * np.diag(found.cov)[3:]).all()
    elsewhere = [preintegrate(interval(b, 340, 360), np.zeros(6), CALIBRATION).cov for b in (whole, holed)]
    np.testing.assert_allclose(elsewhere[0], elsewhere[1], rtol=0.5)


def test_a_hole_too_long_makes_an_interval_unknown() -> None:
    gyro, accel = lively(400, 1.0)
    assert filled(gyro, accel, slice(300, 345)).between(295 * STEP_NS, 350 * STEP_NS) is None


def test_steps_beside_clipped_samples_count_in_full() -> None:
    gyro, accel = lively(400)
    accel *= 2.0  # beyond the least range of such sensors
    size = np.abs(accel[50:350]).max(axis=1)
    at = 50 + int(size.argmax())
    accel[at + 1] = accel[at]  # two samples at the end of the range
    accel[:50] *= 0.1
    accel[350:] *= 0.1
    density = interval(filled(gyro, accel), at - 5, at + 6).density
    assert density is not None
    assert (density[4:8, 1] > 5.0 * density[0, 1]).tolist() == [True, True, True, False]
    assert (density[[0, 1, 2, 3, 7, 8, 9], 1] == density[0, 1]).all() and (density[:, 0] == density[0, 0]).all()


def test_clipped_samples_are_doubted() -> None:
    gyro, accel = lively(400, 1.0)
    accel[300:310, 2] += 15.0
    free, clipped = filled(gyro, accel), filled(gyro, np.minimum(accel, 19.6))
    sure, doubtful = (preintegrate(interval(b, 295, 315), np.zeros(6), CALIBRATION) for b in (free, clipped))
    error = doubtful.vp - sure.vp
    assert np.linalg.norm(error[:3]) > 0.1
    assert (error**2 < 9.0 * np.diag(doubtful.cov)[3:]).all()
    # the gyro was not at its end
    np.testing.assert_allclose(doubtful.cov[:3, :3], sure.cov[:3, :3])


def test_an_extended_copy_leaves_the_buffer_as_it_is() -> None:
    gyro, accel = lively(200, noise=3.0)
    buffer, alone = filled(gyro[:100], accel[:100]), filled(gyro[:100], accel[:100])
    stamps = (np.arange(200) * STEP_NS).astype(np.int64)
    longer = buffer.extended(ImuBatch(stamps[100:], 50.0 * gyro[100:], 50.0 * accel[100:]))
    assert longer.newest_t_ns == stamps[-1]
    for name, value in vars(alone).items():
        assert np.array_equal(getattr(buffer, name), value), name


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


def test_samples_that_have_not_come_are_told_and_hardly_count() -> None:
    gyro, accel = lively(100)
    buffer = filled(gyro, accel)
    newest = 99 * STEP_NS
    assert not buffer.lacks(newest + 5 * STEP_NS) and buffer.lacks(newest + 6 * STEP_NS)
    near, far = interval(buffer, 90, 101), interval(buffer, 90, 109)
    assert near.density is not None and near.density.max() < 0.01
    held = without_held(far)
    assert held.density is not None and held.density[:-1].max() < 0.01
    lasting_s = far.t_s[-1] - far.t_s[-2]
    np.testing.assert_allclose(held.density[-1], np.sqrt(lasting_s) * np.array([2.0, 20.0]))
    assert SampleBuffer(3.0, 0.2).lacks(0)


def test_forces_that_have_not_come_yet_are_those_without_vibration() -> None:
    """One sample of shaken rotors held for 20 ms changed a predicted velocity by 0.1 m/s."""
    buffer, step_ns = SampleBuffer(4.0, 0.5), STEP_NS
    stamps = step_ns * np.arange(60)
    accel = np.tile([0.5, 0.0, 9.8], (60, 1))
    accel[:, 2] += np.resize([6.0, -6.0], 60)  # the newest one is 6 m/s^2 off
    buffer.push(ImuBatch(stamps, np.zeros((60, 3)), accel))
    newest_ns = int(stamps[-1])

    def change(samples: Samples | None) -> F64:
        assert samples is not None
        return np.asarray(np.trapezoid(samples.accel, samples.t_s, axis=0))

    held_s = 0.02
    for ahead in (newest_ns, newest_ns - 2 * step_ns):
        known = change(buffer.between(ahead, newest_ns)) if ahead < newest_ns else np.zeros(3)
        found = change(buffer.ahead(ahead, newest_ns + round(1e9 * held_s)))
        np.testing.assert_allclose(found, known + held_s * np.array([0.5, 0.0, 9.8]), atol=1e-9)
    same = buffer.ahead(0, newest_ns), buffer.between(0, newest_ns)
    assert same[0] is not None and same[1] is not None
    np.testing.assert_array_equal(same[0].accel, same[1].accel)  # nothing is held

"""People are told when an IMU stays silent, once, when it speaks again, and when it does not measure gravity."""

import numpy as np
import pytest

from kiteline_agent.inertial.samples.imu_watch import ImuWatch
from kiteline_core.frame import ImuBatch

_FRAME_NS = 50_000_000


def samples(t_ns: int, n: int = 10, accel_m_s2: float = 9.8) -> ImuBatch:
    return ImuBatch(t_ns + np.arange(n, dtype=np.int64), np.zeros((n, 3)), np.tile([0.0, -accel_m_s2, 0.0], (n, 1)))


def test_a_silence_is_told_once_and_its_end_too() -> None:
    watch = ImuWatch(3.0, 9.81)
    told = {}
    for k in range(300):
        t_ns = k * _FRAME_NS
        speaks = 20 <= k < 100 or k >= 200
        for line in watch.frame(t_ns, samples(t_ns) if speaks else samples(t_ns, 0) if k % 2 else None):
            told[k] = line
    assert told == {
        159: "imu: silent for 3.0 s, the images alone carry the pose",  # the last samples came at frame 99
        200: "imu: samples again",
    }


def test_an_imu_that_never_speaks_is_told_of() -> None:
    watch = ImuWatch(3.0, 9.81)
    told = [line for k in range(200) for line in watch.frame(k * _FRAME_NS, None)]
    assert told == ["imu: silent for 3.0 s, the images alone carry the pose"]


def test_samples_of_another_clock_are_told_once_and_that_they_are_right_again() -> None:
    watch = ImuWatch(3.0, 9.81)
    told = {}
    for k in range(200):
        t_ns = 100 * 10**9 + k * _FRAME_NS
        for line in watch.frame(t_ns, samples(t_ns if k >= 100 else k * _FRAME_NS)):
            told[k] = line
    assert list(told) == [60, 100] and told[100] == "imu: samples again"
    assert told[60].startswith("imu: its samples are stamped 100.0 s before the images and are not used")


@pytest.mark.parametrize("accel_m_s2", [1.0, 0.3, 9810.0])  # in g, without gravity, in mm/s^2
def test_accelerations_that_are_not_gravity_are_told_once(accel_m_s2: float) -> None:
    watch = ImuWatch(3.0, 9.81)
    told = {}
    for k in range(300):
        for line in watch.frame(k * _FRAME_NS, samples(k * _FRAME_NS, accel_m_s2=accel_m_s2)):
            told[k] = line
    assert list(told) == [60]
    assert told[60].startswith(f"imu: accelerations are {accel_m_s2:.3g} m/s^2 in the mean, gravity alone is 9.81:")


def test_a_second_of_free_fall_or_of_a_jolt_is_not_told() -> None:
    for accel_m_s2 in (0.0, 60.0):
        watch = ImuWatch(3.0, 9.81)
        for k in range(100):
            of_frame = samples(k * _FRAME_NS, accel_m_s2=accel_m_s2 if k < 20 else 9.8)
            assert watch.frame(k * _FRAME_NS, of_frame) == []

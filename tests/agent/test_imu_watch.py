"""People are told when an IMU stays silent, once, and when it speaks again."""

import numpy as np

from kiteline_agent.inertial.imu_watch import ImuWatch
from kiteline_core.frame import ImuBatch

_FRAME_NS = 50_000_000


def samples(t_ns: int, n: int = 10) -> ImuBatch:
    return ImuBatch(t_ns + np.arange(n, dtype=np.int64), np.zeros((n, 3)), np.zeros((n, 3)))


def test_a_silence_is_told_once_and_its_end_too() -> None:
    watch = ImuWatch(3.0)
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
    watch = ImuWatch(3.0)
    told = [line for k in range(200) for line in watch.frame(k * _FRAME_NS, None)]
    assert told == ["imu: silent for 3.0 s, the images alone carry the pose"]

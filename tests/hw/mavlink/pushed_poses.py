"""Poses pushed to a sink while a condition holds."""

import time
from collections.abc import Callable

import numpy as np

from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink
from kiteline_hw.ports import PoseSample
from kiteline_hw.system.clock import MonotonicClock

CLOCK = MonotonicClock()


def push_while(sink: MavlinkPoseSink, condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Feed poses at 100 Hz until the condition fails."""
    deadline_s = time.monotonic() + timeout_s
    while condition():
        assert time.monotonic() < deadline_s, "nothing happened in time"
        now_ns = CLOCK.now_ns()
        sink.push(PoseSample(now_ns, np.eye(4), True, 90), now_ns)
        time.sleep(0.01)

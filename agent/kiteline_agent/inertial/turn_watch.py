"""How the gyro and the images turn over a while, for the time offset between them: compared once all samples are there.

Rates have to change by far more than the gyro's noise, which looks like changes that no offset explains and pulls it
towards zero: hence windows of several frames, and the mean of many samples for the rate at either end. With stamps
of the IMU that run ahead of the camera's, the samples of a frame come after it: hence a frame or two of patience.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.inertial.preintegration import SampleBuffer, preintegrate
from kiteline_agent.inertial.time_offset import TimeOffsetEstimator
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

F64 = NDArray[np.float64]

_RATE_NS = 12_000_000  # to either side of an instant, of which samples tell the rate there
_LONGEST = 4.0  # times the window: longer ones have a hole
_FRAMES = 64  # most that are kept


class TurnWatch:
    """`see` each frame that the images placed; `look` when samples came."""

    def __init__(self, calibration: ImuCalibration, window_s: float) -> None:
        self._calibration = calibration
        self._window_s = window_s
        self._seen: list[tuple[int, F64]] = []

    def see(self, t_ns: int, R_m_b: F64) -> None:
        """The images alone say R_m_b (3,3)."""
        self._seen = [*self._seen, (t_ns, R_m_b.copy())][-_FRAMES:]

    def forget(self) -> None:
        """The images were lost, or a new map begins."""
        self._seen = []

    def turn_map(self, R_new_old: F64) -> None:
        """The map turned by (3,3)."""
        self._seen = [(t, R_new_old @ R) for t, R in self._seen]

    def look(self, buffer: SampleBuffer, offset_s: float, estimator: TimeOffsetEstimator) -> None:
        """Tell the estimator of the next window, if its samples are there: camera stamp + offset_s is their time."""
        newest = buffer.newest_t_ns
        shift = round(offset_s * 1e9)
        if newest is None or len(self._seen) < 2:
            return
        begin_ns, begin = self._seen[0]
        ready = (k for k in range(1, len(self._seen)) if (self._seen[k][0] - begin_ns) * 1e-9 >= self._window_s)
        last = next(ready, None)
        if last is None or self._seen[last][0] + shift + _RATE_NS > newest:
            return
        end_ns, end = self._seen[last]
        self._seen = self._seen[last:]
        length_s = (end_ns - begin_ns) * 1e-9
        samples = buffer.between(begin_ns + shift, end_ns + shift)
        rates = [buffer.mean(t + shift - _RATE_NS, t + shift + _RATE_NS) for t in (begin_ns, end_ns)]
        if samples is None or length_s > _LONGEST * self._window_s or min(n for _, _, n in rates) == 0:
            return
        # the bias is left in, since the smoother's would itself follow a wrong offset
        turn = preintegrate(samples, np.zeros(6), self._calibration).turn
        change = rates[1][0][:3] - turn.T @ rates[0][0][:3]
        error = se3.so3_log(turn.T @ begin.T @ end)
        estimator.add(error + change * offset_s, change, length_s)

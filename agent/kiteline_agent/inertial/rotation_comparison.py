"""Comparison of rotations by gyro and images over short windows, for the time offset between them.

A window is several frames long, and the rates at its ends are means of several samples: the change of rate must exceed
the gyro noise, which would bias the offset towards zero. A window is compared once all its samples have arrived, since
IMU stamps may be ahead of the camera's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.inertial.preintegration import preintegrate
from kiteline_agent.inertial.sample_buffer import SampleBuffer
from kiteline_agent.inertial.time_offset import TimeOffsetEstimator
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

F64 = NDArray[np.float64]

_RATE_NS = 12_000_000  # to either side of an instant, averaged for the rate there
_LONGEST = 4.0  # times the window: longer ones have a gap
_FRAMES = 64  # most frames that are kept


class RotationComparison:
    """Rotations by the images over the newest frames, for comparison with the gyro."""

    def __init__(self, calibration: ImuCalibration, window_s: float) -> None:
        self._calibration = calibration
        self._window_s = window_s
        self._rotations: list[tuple[int, F64]] = []

    def add(self, t_ns: int, R_m_b: F64) -> None:
        """Append the rotation R_m_b (3,3) of a frame, by images alone."""
        self._rotations = [*self._rotations, (t_ns, R_m_b.copy())][-_FRAMES:]

    def clear(self) -> None:
        """Begin again after an image loss or in a new map."""
        self._rotations = []

    def rotate_map(self, R_new_old: F64) -> None:
        """Rotate the stored rotations with the map by R_new_old (3,3)."""
        self._rotations = [(t, R_new_old @ R) for t, R in self._rotations]

    def compare(self, buffer: SampleBuffer, offset_s: float, estimator: TimeOffsetEstimator) -> None:
        """Add the next window to the estimator, once its samples have arrived. offset_s: camera stamp to IMU time."""
        newest = buffer.newest_t_ns
        shift = round(offset_s * 1e9)
        if newest is None or len(self._rotations) < 2:
            return
        begin_ns, begin = self._rotations[0]
        ready = (
            k for k in range(1, len(self._rotations)) if (self._rotations[k][0] - begin_ns) * 1e-9 >= self._window_s
        )
        last = next(ready, None)
        if last is None or self._rotations[last][0] + shift + _RATE_NS > newest:
            return
        end_ns, end = self._rotations[last]
        self._rotations = self._rotations[last:]
        length_s = (end_ns - begin_ns) * 1e-9
        samples = buffer.between(begin_ns + shift, end_ns + shift)
        rates = [buffer.mean(t + shift - _RATE_NS, t + shift + _RATE_NS) for t in (begin_ns, end_ns)]
        if samples is None or length_s > _LONGEST * self._window_s or min(n for _, _, n in rates) == 0:
            return
        # The bias is not subtracted: the smoother's estimate depends on the time offset.
        rotation = preintegrate(samples, np.zeros(6), self._calibration).turn
        change = rates[1][0][:3] - rotation.T @ rates[0][0][:3]
        error = se3.so3_log(rotation.T @ begin.T @ end)
        estimator.add(error + change * offset_s, change, length_s)

"""By how much the camera's stamps are early: the lag at which the gyro turns as the images do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_BIAS_RAD_S = 0.1  # deviation of a gyro bias before anything is known


class TimeOffsetEstimator:
    """Recursive least squares with forgetting over [offset s, gyro bias rad/s].

    Moving an interval by d turns the gyro's rotation by d (rate at its end - turned rate at its begin), so every
    frame gives three equations (after M. Li, A. Mourikis, "Online temporal calibration for camera-IMU systems",
    2014).
    """

    def __init__(self, memory_s: float, start_sigma_s: float, turn_sigma_rad: float, start_s: float = 0.0) -> None:
        """memory_s: time constant of forgetting. turn_sigma_rad: error of a visual turn between two frames. start_s:
        the offset as configured.
        """
        self._memory_s = memory_s
        self._weight = turn_sigma_rad**-2.0
        self._prior = np.diag([start_sigma_s**-2.0, *3 * [_BIAS_RAD_S**-2.0]])
        self._at_start = self._prior @ np.array([start_s, 0.0, 0.0, 0.0])
        self._h, self._g = self._prior.copy(), self._at_start.copy()

    def add(self, error: F64, rate_change: F64, dt_s: float) -> None:
        """error: (3,) Log(gyro_turn^T visual_turn) with an interval taken at the present offset 0 of this estimator.
        rate_change: (3,) rate at the end less turn^T rate at the begin, rad/s. dt_s: length of the interval.
        """
        j = np.column_stack([rate_change, -dt_s * np.eye(3)])
        size = float(np.sqrt(error @ error))
        w = self._weight * min(1.0, 4.0 / (size * np.sqrt(self._weight) + 1e-12))
        keep = float(np.exp(-dt_s / self._memory_s))
        self._h = keep * self._h + (1.0 - keep) * self._prior + w * (j.T @ j)
        self._g = keep * self._g + (1.0 - keep) * self._at_start + w * (j.T @ error)

    @property
    def offset_s(self) -> float:
        """Camera stamp + offset = time of the IMU."""
        return float(np.linalg.solve(self._h, self._g)[0])

    @property
    def sigma_s(self) -> float:
        """One standard deviation of it."""
        return float(np.sqrt(np.linalg.inv(self._h)[0, 0]))

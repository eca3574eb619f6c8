"""Time offset between camera and IMU: the lag at which the gyro's rotations match those of the images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_BIAS_RAD_S = 0.1  # standard deviation of an unknown gyro bias


class TimeOffsetEstimator:
    """Recursive least squares with forgetting over [offset s, gyro bias rad/s].

    Shifting an interval by d rotates the gyro's rotation by d (rate at its end - rotated rate at its start), so each
    interval gives three equations (after M. Li, A. Mourikis, "Online temporal calibration for camera-IMU systems",
    2014).
    """

    def __init__(self, memory_s: float, start_sigma_s: float, turn_sigma_rad: float, start_s: float = 0.0) -> None:
        """memory_s: time constant of forgetting. turn_sigma_rad: error of a rotation. start_s: initial offset."""
        self._memory_s = memory_s
        self._weight = turn_sigma_rad**-2.0
        self._prior = np.diag([start_sigma_s**-2.0, *3 * [_BIAS_RAD_S**-2.0]])
        self._at_start = self._prior @ np.array([start_s, 0.0, 0.0, 0.0])
        self._h, self._g = self._prior.copy(), self._at_start.copy()

    def add(self, error: F64, rate_change: F64, dt_s: float) -> None:
        """Add an interval of dt_s.

        error: (3,) Log(R_gyro^T R_images) at offset 0. rate_change: (3,) rate at the end less R^T rate at the start,
        rad/s.
        """
        j = np.column_stack([rate_change, -dt_s * np.eye(3)])
        size = float(np.sqrt(error @ error))
        w = self._weight * min(1.0, 4.0 / (size * np.sqrt(self._weight) + 1e-12))
        keep = float(np.exp(-dt_s / self._memory_s))
        self._h = keep * self._h + (1.0 - keep) * self._prior + w * (j.T @ j)
        self._g = keep * self._g + (1.0 - keep) * self._at_start + w * (j.T @ error)

    @property
    def offset_s(self) -> float:
        """Camera stamp + offset = IMU time."""
        return float(np.linalg.solve(self._h, self._g)[0])

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the offset."""
        return float(np.sqrt(np.linalg.inv(self._h)[0, 0]))

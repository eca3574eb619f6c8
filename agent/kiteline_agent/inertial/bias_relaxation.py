"""Lets biases follow a calibration that has just changed: they were learned from samples that it now corrects."""

import numpy as np

from kiteline_core.arrays import F64

_OFFSET_RATE = 4e-3  # s/s; slower changes of the applied time offset leave biases as they are
_GYRO_RATE = 4e-3  # 1/s, of an element of the gyro's axes
_ACCEL_RATE = 8e-3  # 1/s, of an element of the accelerometer's axes
_AFTER_S = 1.0  # s for which biases are free after a change: the smoother's window, and what its prior has learned
_WALK = np.array([5e-3, 0.02])  # rad/s/sqrt(s) and m/s^2/sqrt(s) by which they may move meanwhile


class BiasRelaxation:
    """Watches the applied values of a calibration."""

    def __init__(self) -> None:
        self._before: tuple[float, F64, F64] | None = None
        self._left_s = 0.0

    def walk(self, offset_s: float, gyro: F64, accel: F64, dt_s: float) -> F64:
        """Density (2,) of the biases' walk beside that of the IMU, over the next dt_s.

        offset_s, gyro, accel: the applied time offset and axes (3,3) of both sensors.
        """
        before, self._before = self._before, (offset_s, gyro, accel)
        self._left_s = max(self._left_s - dt_s, 0.0)
        if before is not None:
            moved = abs(offset_s - before[0]) > _OFFSET_RATE * dt_s
            moved |= bool(np.abs(gyro - before[1]).max() > _GYRO_RATE * dt_s)
            moved |= bool(np.abs(accel - before[2]).max() > _ACCEL_RATE * dt_s)
            self._left_s = _AFTER_S if moved else self._left_s
        return _WALK if self._left_s > 0.0 else np.zeros(2)

"""How far an IMU is from what the images measure: a wrong calibration, unit or clock is no error of a few percent."""

import numpy as np

from kiteline_core.arrays import F64

_PROVED = 4  # windows after which a sensor that agrees is known to


class Disagreement:
    """Squared errors of an IMU over the squared motion by images, over the last seconds."""

    def __init__(self, memory_s: float, least: float, most_share: float, most_bias: float) -> None:
        """memory_s: time constant. least: squared motion below which errors of bias and images count. most_share: of
        the squared motion, from which the sensor contradicts the images. most_bias: of a sensor, in units of the motion
        a second: the first window is off by that.
        """
        self._memory_s, self._least, self._most_share, self._most_bias = memory_s, least, most_share, most_bias
        self._error = self._motion = 0.0
        self._windows = 0

    def add(self, motion: F64, error: F64, variance: float, dt_s: float) -> None:
        """Add a window: what the images measured (3,), and by how much the IMU's prediction of it was off (3,).

        variance: of an axis of the error by noise of images and IMU, vibration included.
        """
        size = float(np.linalg.norm(error))
        if self._windows == 0:
            size = max(size - self._most_bias * dt_s, 0.0)
        kept = float(np.exp(-dt_s / self._memory_s))
        self._error = kept * self._error + max(size**2 - 3.0 * variance, 0.0)
        self._motion = kept * self._motion + float(motion @ motion)
        self._windows += 1

    @property
    def share(self) -> float:
        """Squared errors over squared motion."""
        return self._error / (self._motion + self._least)

    @property
    def contradicts(self) -> bool:
        """True if no calibrated sensor is as far off."""
        return self.share > self._most_share

    @property
    def agrees(self) -> bool:
        """True if several windows fit."""
        return self._windows >= _PROVED and self.share < 0.5 * self._most_share

    @property
    def moves(self) -> bool:
        """True if there is enough motion to tell."""
        return self._motion > self._least

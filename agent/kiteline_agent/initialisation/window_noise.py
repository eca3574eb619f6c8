"""How noisy the IMU is beside its calibration, as the errors of a window show it."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64

MOST = 25.0  # largest factor on a deviation
LEAST = 0.2  # and the smallest


@dataclass(frozen=True, slots=True)
class WindowNoise:
    """Factors on the deviations of the inertial error model.

    gyro, accel: of white noise. walk: of the accelerometer bias's walk, with which errors of scale and axes come.
    """

    gyro: float = 1.0
    accel: float = 1.0
    walk: float = 1.0


@dataclass(frozen=True, slots=True)
class NoiseEvidence:
    """Squared errors of gyro, accelerometer and bias walk (3,) in deviations, and their expectation (3,)."""

    chi2: F64
    expected: F64

    def updated(self, noise: WindowNoise, prior: float, least_accel: float = LEAST) -> WindowNoise:
        """The factors that explain these errors. prior: weight of 1, which is expected, in degrees of freedom.

        least_accel: smallest factor of the accelerometer's white noise that is believed.
        """
        before = np.array([noise.gyro, noise.accel, noise.walk])
        found = np.sqrt((before**2 * self.chi2 + prior) / (self.expected + prior))
        gyro, accel, walk = (float(x) for x in np.clip(found, LEAST, MOST))
        return WindowNoise(gyro, max(accel, least_accel), walk)

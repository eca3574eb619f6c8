"""The noise of the IMU from window to window, which shows it, and the deviation of the scale that is left."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.inertial_start_config import InertialBundleConfig
from kiteline_agent.initialisation.window.window_noise import (
    LEAST,
    MOST,
    Vibration,
    WindowNoise,
    vibration,
)
from kiteline_agent.initialisation.window.window_state import WindowSolution
from kiteline_core.frame import ImuCalibration

_LEAST_ACCEL_NOISE = 0.5  # times the noise of single samples: vibration averages out to half of it


class NoiseOfWindows:
    """Call `measure` before a window is solved, and `seen` with its solution.

    now: the noise with which a window is solved. of_samples: that of single samples, with which the first window is
    solved. It is more than intervals have, since vibration and fast motion average out; from there the errors of a
    solution show how much there is, while with too little a solution takes noise for motion.
    """

    def __init__(self, calibration: ImuCalibration, config: InertialBundleConfig) -> None:
        self._calibration, self._config = calibration, config
        self.clear()

    def clear(self) -> None:
        """Begin anew, as after a map."""
        self.now = self.of_samples = WindowNoise()
        self._vibration: Vibration | None = None

    @property
    def level_now(self) -> float:
        """Vibration of the newest intervals over its mean in the window."""
        return 1.0 if self._vibration is None else self._vibration.level_now

    @property
    def vibration_m_s2(self) -> float:
        """Deviation of the accelerometer's samples in the window; 0 where it is that of a calibrated sensor at rest."""
        return 0.0 if self._vibration is None or self.of_samples.accel <= 1.0 else self._vibration.deviation

    def measure(self, intervals: Sequence[Samples], gyro_density: float) -> None:
        """Measure the vibration of a window; the noise found so far is that of the mean over the window before.

        gyro_density: noise of the gyro's single samples, rad/s per sqrt(Hz).
        """
        before, found = self._vibration, vibration(intervals)
        told, factor = self._calibration, self._config.imu_inflation
        gyro, accel = gyro_density / factor / told.gyro_noise, found.density / factor / told.accel_noise
        self._vibration = found
        self.of_samples = WindowNoise(float(np.clip(gyro, 1.0, MOST)), float(np.clip(accel, 1.0, MOST)))
        if before is None:
            self.now = self.of_samples
        elif before.density > 0.0:
            accel = self.now.accel * found.density / before.density
            self.now = replace(self.now, accel=float(np.clip(accel, LEAST, MOST)))

    def seen(self, solution: WindowSolution) -> tuple[WindowNoise, float]:
        """The noise as a solution shows it, and the deviation of its scale with that."""
        before = self.now
        now = solution.evidence.updated(before, _LEAST_ACCEL_NOISE * self.of_samples.accel)
        return now, solution.scale_sigma * max(now.accel / before.accel, now.walk / before.walk)

"""How noisy the IMU is: in a window, by a solution's errors, and in each of its intervals, by vibration."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial import imu_kernels
from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.inertial.samples.sample_buffer import EVEN, GAP
from kiteline_core.arrays import F64

MOST = 25.0  # largest factor on a deviation
LEAST = 0.2  # and the smallest
_FEWEST = 12  # second differences that tell the noise of an interval, to a fifth
_LEAST_LEVEL, _MOST_LEVEL = 0.1, 4.0  # motors are off, and a landing
_BESIDE = 2  # intervals before and after, half a second each, over which levels are averaged: rotors beat
_PRIOR = 6.0  # degrees of freedom of the calibrated noise beside those of a window
_NEWEST = 2  # intervals that tell the vibration now


@dataclass(frozen=True, slots=True)
class WindowNoise:
    """Factors on the deviations of the inertial error model.

    gyro, accel: of white noise. walk: of the random walk of the accelerometer's bias, which also stands for errors of
    its scale and axes.
    """

    gyro: float = 1.0
    accel: float = 1.0
    walk: float = 1.0


@dataclass(frozen=True, slots=True)
class NoiseEvidence:
    """Squared errors of gyro, accelerometer and bias walk (3,) in deviations, and their expectation (3,)."""

    chi2: F64
    expected: F64

    def updated(self, noise: WindowNoise, least_accel: float = LEAST) -> WindowNoise:
        """The factors that explain these errors, with 1 as prior.

        least_accel: smallest factor of the accelerometer's white noise that is believed.
        """
        before = np.array([noise.gyro, noise.accel, noise.walk])
        found = np.sqrt((before**2 * self.chi2 + _PRIOR) / (self.expected + _PRIOR))
        gyro, accel, walk = (float(x) for x in np.clip(found, LEAST, MOST))
        return WindowNoise(gyro, max(accel, least_accel), walk)


@dataclass(frozen=True, slots=True)
class Vibration:
    """Noise of single samples of the accelerometer. density: root mean square over a window, m/s^2 per sqrt(Hz).

    deviation: of one sample, m/s^2. levels: (K-1,) deviation of the noise about each interval over that mean.
    """

    density: float
    deviation: float
    levels: F64

    @property
    def level_now(self) -> float:
        """Level of the newest intervals."""
        return float(np.sqrt(np.mean(self.levels[-_NEWEST:] ** 2)))


def vibration(intervals: Sequence[Samples]) -> Vibration:
    """The vibration over K - 1 intervals, by second differences as in SampleBuffer. With few samples a level is 1."""
    usual_s = float(np.median(np.concatenate([np.diff(samples.t_s) for samples in intervals])))
    variance, sums = np.full(len(intervals), np.nan), np.empty((2, 2))
    for k, samples in enumerate(intervals):
        values = np.concatenate([samples.gyro, samples.accel], axis=1)[1:-1]  # the ends are interpolated
        stamps = np.round(1e9 * samples.t_s[1:-1]).astype(np.int64)
        count, pairs = imu_kernels.second_differences(stamps, values, 1e9 * usual_s, EVEN, GAP, sums)
        if count >= _FEWEST:
            by_pairs = sums[1, 1] / pairs if pairs >= _FEWEST else np.inf
            variance[k] = min(sums[0, 1] / count, by_pairs)
    known = np.isfinite(variance)
    mean = float(variance[known].mean()) if known.any() else 0.0
    if mean == 0.0:
        return Vibration(0.0, 0.0, np.ones(len(intervals)))
    even = np.pad(np.where(known, variance, mean) / mean, _BESIDE, mode="edge")
    around = np.convolve(even, np.full(2 * _BESIDE + 1, 1.0 / (2 * _BESIDE + 1)), mode="valid")
    levels = np.clip(np.sqrt(around), _LEAST_LEVEL, _MOST_LEVEL)
    return Vibration(float(np.sqrt(mean * usual_s)), float(np.sqrt(mean)), levels)

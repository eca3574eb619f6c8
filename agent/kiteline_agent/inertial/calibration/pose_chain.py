"""Poses by images at the ends of windows, each with the IMU samples since the one before.

The rates at the ends are means of several samples: the change of rate must exceed the gyro noise, which would bias the
time offset towards zero. A window is complete once all its samples have arrived, since IMU stamps may be ahead of the
camera's.
"""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration

_RATE_NS = 12_000_000  # to either side of an instant, averaged for the rate there
_LONGEST = 4.0  # times the window: longer ones have a gap
_FRAMES = 64  # that are kept, and those of a window and this much longer, which fast cameras have more of
_KEPT_S = 0.5  # s by which samples may come after their frames


@dataclass(frozen=True, slots=True)
class SampledMotion:
    """Raw samples between two frames, and the poses (4,4) by images at both. rates: (2,3) rad/s, raw, at both.

    frames: all of the window, with these two: IMU time and pose (4,4).
    """

    samples: Samples
    T_m_b0: F64
    T_m_b1: F64
    rates: F64
    frames: tuple[tuple[int, F64], ...]

    def density(self, calibration: ImuCalibration) -> F64:
        """(2,) noise density of gyro and accelerometer: the calibrated one, or what was measured if that is larger."""
        calibrated = np.array([calibration.gyro_noise, calibration.accel_noise])
        measured = self.samples.density
        return calibrated if measured is None else np.maximum(calibrated, np.sqrt(np.mean(measured**2, axis=0)))


class PoseChain:
    """Poses T_m_b by images over the newest frames, cut into windows of equal length."""

    def __init__(self, window_s: float) -> None:
        self._window_s = window_s
        self._poses: list[tuple[int, F64]] = []

    def add(self, t_ns: int, T_m_b: F64) -> None:
        """Append the pose T_m_b (4,4) of a frame, by images alone."""
        poses, oldest_ns = [*self._poses, (t_ns, T_m_b.copy())], t_ns - round((self._window_s + _KEPT_S) * 1e9)
        first = max(len(poses) - _FRAMES, 0)
        while first and poses[first - 1][0] >= oldest_ns:
            first -= 1
        self._poses = poses[first:]

    def clear(self) -> None:
        """Begin again after an image loss or in a new map."""
        self._poses = []

    def move_map(self, T_new_old: F64) -> None:
        """Move the poses with the map: p_new = T_new_old p_old."""
        self._poses = [(t, T_new_old @ T) for t, T in self._poses]

    def take(self, buffer: SampleBuffer, offset_s: float) -> SampledMotion | bool:
        """The next window, once its samples have arrived; True: it has a gap, False: not yet. offset_s: camera stamp
        to IMU time.
        """
        newest, shift = buffer.newest_t_ns, round(offset_s * 1e9)
        if newest is None or not self._poses:
            return False
        begin_ns, begin = self._poses[0]
        ready = (k for k, (t_ns, _) in enumerate(self._poses) if (t_ns - begin_ns) * 1e-9 >= self._window_s)
        last = next(ready, None)
        if last is None or self._poses[last][0] + shift + _RATE_NS > newest:
            return False
        end_ns, end = self._poses[last]
        frames = tuple((t + shift, T) for t, T in self._poses[: last + 1])
        self._poses = self._poses[last:]
        samples = buffer.between(begin_ns + shift, end_ns + shift)
        rates = [rate_at(buffer, t + shift) for t in (begin_ns, end_ns)]
        if samples is None or samples.duration_s > _LONGEST * self._window_s or rates[0] is None or rates[1] is None:
            return True
        return SampledMotion(samples, begin, end, np.array(rates), frames)


def rate_at(buffer: SampleBuffer, t_ns: int) -> F64 | None:
    """Raw rate (3,) rad/s at an instant; None without samples."""
    near = buffer.within(t_ns - _RATE_NS, t_ns + _RATE_NS)
    return np.add.reduce(near[:, :3]) / len(near) if len(near) else None

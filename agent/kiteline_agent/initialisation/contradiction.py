"""Images and IMU that contradict each other: how a window shows it, and the event once it lasts."""

import numpy as np

from kiteline_agent.inertial.preintegration import BiasPrior
from kiteline_agent.inertial_start_config import ContradictionConfig
from kiteline_agent.initialisation.inertial_window import WindowSolution
from kiteline_core.arrays import F64

_WARNING = (
    "imu: images and IMU contradict each other, so that no scale is known: check the camera's place in the IMU's axes "
    "(T_BS), the time offset, the intrinsics and the units (rad/s, m/s^2)"
)


def contradicts(
    solution: WindowSolution, gyro_noise: float, prior: BiasPrior, lens_info: F64, config: ContradictionConfig
) -> bool:
    """True if a window fits only with errors of lens, gyro or accelerometer that no calibrated sensor has.

    gyro_noise: factor on the noise of single samples that the rotations show. lens_info: (8,8) inverse covariance of
    the errors of a calibrated camera. The scale of such a window is wrong, however small its deviation.
    """
    lens = float(solution.state.lens @ lens_info @ solution.state.lens)
    off = (solution.bias[3:] - prior.bias[3:]) / prior.sigma[3:]
    return bool(
        lens > config.lens_chi2
        or gyro_noise > config.gyro_noise
        or (lens > config.both_lens_chi2 and gyro_noise > config.both_gyro_noise)
        or np.abs(off).max() > config.accel_bias
    )


def exceeds_lens_errors(
    solution: WindowSolution, gyro_noise: float, prior: BiasPrior, config: ContradictionConfig
) -> bool:
    """True if a window that contradicts does so by more than its lens: a lens may be off beside a true IMU."""
    off = (solution.bias[3:] - prior.bias[3:]) / prior.sigma[3:]
    return bool(gyro_noise > config.both_gyro_noise or np.abs(off).max() > config.accel_bias)


class ContradictionWatch:
    """Reports once that all windows of some seconds contradict, and again after one that does not.

    certain: they do by the IMU, every one, or for so long that no window will tell more.
    """

    def __init__(self, config: ContradictionConfig) -> None:
        self._config = config
        self._since_ns: int | None = None  # first of the windows that contradict
        self._by_imu_since_ns: int | None = None  # first of those in a row that do by more than the lens
        self._told = False
        self.certain = False

    def note(self, t_ns: int, *, contradicts: bool | None, by_imu: bool = True) -> list[str]:
        """Process a window that ends at t_ns; returns the events for the log. contradicts: None if it tells neither."""
        if contradicts is None:
            self._by_imu_since_ns = None  # as with people all over the view, who shake it
            return []
        if not contradicts:
            self._since_ns = self._by_imu_since_ns = None
            self._told = self.certain = False
            return []
        since_ns = self._since_ns = t_ns if self._since_ns is None else self._since_ns
        by_imu_ns = t_ns if self._by_imu_since_ns is None else self._by_imu_since_ns
        self._by_imu_since_ns = by_imu_ns if by_imu else None
        lasts_ns, unsure_ns = (round(1e9 * s) for s in (self._config.lasts_s, self._config.unsure_s))
        self.certain = (by_imu and t_ns - by_imu_ns >= lasts_ns) or t_ns - since_ns >= unsure_ns
        if self._told or t_ns - since_ns < lasts_ns:
            return []
        self._told = True
        return [_WARNING]

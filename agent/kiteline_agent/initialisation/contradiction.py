"""What keeps windows from a scale: images and IMU that contradict each other, or too little motion; and the events."""

import numpy as np

from kiteline_agent.inertial.preintegration import BiasPrior
from kiteline_agent.inertial_start_config import ContradictionConfig
from kiteline_agent.initialisation.window.window_state import WindowSolution
from kiteline_core.arrays import F64

_WARNING = (
    "imu: images and IMU contradict each other, so that no scale is known: check the camera's place in the IMU's axes "
    "(T_BS), the intrinsics, the units (rad/s, m/s^2) and the time offset (one of up to 0.15 s is found)"
)
_NO_SCALE = (
    "imu: no scale is known after {:.0f} s in motion, and no pose in metres before{}: speed up and slow down, in "
    "changing directions; if that was flown, check the signs of the accelerations, and that samples come at 200 Hz and "
    "without gaps, or fewer as means over their steps; --no-imu flies the images alone, in a unit of their own"
)
_KNOWN = "; lengths are known to {:.1f} %, and {:g} % are needed"
_VIBRATION = ", with vibration of {:.1f} m/s^2 (a softer mount of the IMU lowers it)"
_WAITS_S = 10.0  # s of windows in motion without a scale, after which it is said: most starts know it after 6 s
_APART_S = 2.5  # s between two windows, at most: between those further apart the vehicle stood still
_BOTH_LENS_CHI2 = 12.0  # with _BOTH_GYRO_NOISE: a focal length that is off by a tenth has 13
_BOTH_GYRO_NOISE = 1.7  # with _BOTH_LENS_CHI2: a focal length that is off by a tenth has 1.9, worn rigs 1.2
_ACCEL_BIAS = 5.0  # deviations of the accelerometer's bias: that of missing gravity is 40
_LENS_CHI2 = 26.0  # squared deviations of the eight errors of a lens: 99.9 % of calibrations have less
_GYRO_NOISE = 5.0  # times that of single samples, as rotations by images show it


def contradicts(solution: WindowSolution, gyro_noise: float, prior: BiasPrior, lens_info: F64) -> bool:
    """True if a window fits only with errors of lens, gyro or accelerometer that no calibrated sensor has.

    gyro_noise: factor on the noise of single samples that the rotations show. lens_info: (8,8) inverse covariance of
    the errors of a calibrated camera. The scale of such a window is wrong, however small its deviation.
    """
    lens = float(solution.state.lens @ lens_info @ solution.state.lens)
    off = (solution.bias[3:] - prior.bias[3:]) / prior.sigma[3:]
    return bool(
        lens > _LENS_CHI2
        or gyro_noise > _GYRO_NOISE
        or (lens > _BOTH_LENS_CHI2 and gyro_noise > _BOTH_GYRO_NOISE)
        or np.abs(off).max() > _ACCEL_BIAS
    )


def exceeds_lens_errors(solution: WindowSolution, gyro_noise: float, prior: BiasPrior) -> bool:
    """True if a window that contradicts does so by more than its lens: a lens may be off beside a true IMU."""
    off = (solution.bias[3:] - prior.bias[3:]) / prior.sigma[3:]
    return bool(gyro_noise > _BOTH_GYRO_NOISE or np.abs(off).max() > _ACCEL_BIAS)


class ContradictionWatch:
    """Reports once that all windows of some seconds contradict, and again after one that does not.

    Windows that tell no scale for long are reported once in a flight, unless they contradicted. certain: windows
    contradict by the IMU, every one, or for so long that none will tell more.
    """

    def __init__(self, config: ContradictionConfig) -> None:
        self._config = config
        self._since_ns: int | None = None  # first of the windows that contradict
        self._by_imu_since_ns: int | None = None  # first of those in a row that do by more than the lens
        self._told = False
        self._window_ns: int | None = None  # of the last window of this start
        self._moved_s, self._wait_told = 0.0, False
        self._so_far = ""  # how well the newest window tells lengths
        self.certain = False

    def begin_again(self) -> None:
        """A map has begun: the next start waits for its scale anew."""
        self._window_ns, self._moved_s, self._so_far = None, 0.0, ""

    def note_lengths(self, sigma: float, needed: float, vibration_m_s2: float) -> None:
        """A window fits: the relative deviation of its lengths, that which is needed, and the vibration in it."""
        shakes = _VIBRATION.format(vibration_m_s2) if vibration_m_s2 > 0.0 else ""
        self._so_far = _KNOWN.format(100.0 * sigma, 100.0 * needed) + shakes if sigma > needed else ""

    def note(self, t_ns: int, *, contradicts: bool | None, by_imu: bool = True) -> list[str]:
        """Process a window that ends at t_ns; returns the events for the log. contradicts: None if it tells neither."""
        return self._note_contradiction(t_ns, contradicts, by_imu) or self.note_wait(t_ns)

    def note_wait(self, t_ns: int) -> list[str]:
        """Count the time in motion without a scale, also that of windows that miss samples; returns the event."""
        if self._window_ns is not None:
            self._moved_s += min(1e-9 * (t_ns - self._window_ns), _APART_S)
        self._window_ns = t_ns
        if self._wait_told or self._moved_s < _WAITS_S:
            return []
        self._wait_told = True
        return [_NO_SCALE.format(self._moved_s, self._so_far)]

    def _note_contradiction(self, t_ns: int, contradicts: bool | None, by_imu: bool) -> list[str]:
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
        self._told = self._wait_told = True
        return [_WARNING]

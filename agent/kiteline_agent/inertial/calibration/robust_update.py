"""What the filters of gyro and accelerometer share: their axes and bias, and an update in which outliers weigh less."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from kiteline_core.arrays import F64

_OUTLIER = 9.0  # squared error over its variance from which a window weighs less
_EXCESS_GAIN = 0.05  # weight of a window in `excess`: the mean reaches over about 20
_EXCESS_MAX = 25.0  # one wrong pose moves the mean by no more than an error of 5 deviations


@dataclass(frozen=True, slots=True)
class RobustUpdate:
    """gain: (n,3). s: (3,3) covariance of the error; predicted: (3,3), its part by the state. square: mean, over s.

    log_likelihood: natural logarithm of the error's density, an outlier's with its larger variance.
    """

    gain: F64
    s: F64
    predicted: F64
    square: float
    log_likelihood: float


def robust_update(j: F64, cov: F64, error: F64, variance: float) -> RobustUpdate:
    """Update by an error (3,) with Jacobian j (3,n), state covariance (n,n) and this variance of the measurement."""
    predicted = j @ cov @ j.T
    s = predicted + variance * np.eye(3)
    square = float(error @ np.linalg.solve(s, error)) / 3.0
    if square > _OUTLIER:
        s = predicted + variance * square / _OUTLIER * np.eye(3)
    log_likelihood = -0.5 * float(error @ np.linalg.solve(s, error) + np.linalg.slogdet(s)[1])
    return RobustUpdate(np.asarray(np.linalg.solve(s, j @ cov).T), s, predicted, square, log_likelihood)


class AxesFilter:
    """What both calibrations know of their sensor: the state begins with `matrix` - 1, and has the bias at BIAS."""

    BIAS: ClassVar[slice]
    _x: F64
    _cov: F64
    excess: float  # mean squared error over what was expected

    @property
    def matrix(self) -> F64:
        """(3,3) of true = matrix @ measured - bias."""
        return np.asarray(np.eye(3) + self._x[:9].reshape(3, 3))

    @property
    def bias(self) -> F64:
        """(3,) rad/s or m/s^2."""
        return self._x[self.BIAS].copy()

    @property
    def axes_cov(self) -> F64:
        """(9,9) covariance of the elements of `matrix`."""
        return self._cov[:9, :9]

    def significance(self) -> float:
        """Squared deviations of the axes from a true IMU; less where errors are larger than expected."""
        return float(self._x[:9] @ np.linalg.solve(self.axes_cov, self._x[:9])) / max(self.excess, 1.0)

    def _count_excess(self, square: float) -> None:
        """Take a window's mean squared error over its variance into `excess`."""
        self.excess += _EXCESS_GAIN * (min(square, _EXCESS_MAX) - self.excess)

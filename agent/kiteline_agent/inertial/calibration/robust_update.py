"""Gain of a Kalman update in which an outlier weighs less: what both calibrations do with a window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_OUTLIER = 9.0  # squared error over its variance from which a window weighs less


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


def significance(axes: F64, cov: F64, excess: float) -> float:
    """Squared deviations of axes (9,) from a true IMU; less where errors are larger than expected."""
    return float(axes @ np.linalg.solve(cov, axes)) / max(excess, 1.0)

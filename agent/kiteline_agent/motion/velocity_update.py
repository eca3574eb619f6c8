"""Kalman update of a vector that is measured directly, with noise that is partly correlated over time."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64


@dataclass(slots=True)
class KalmanUpdate:
    """Result of `blend`: a vector (3,), its covariance and the correlated part of it (3,3), and the gain (3,3)."""

    value: F64
    cov: F64
    slow: F64
    gain: F64
    accepted: bool


def blend(value: F64, cov: F64, measured: F64, fast: F64, slow: F64, gate: float) -> KalmanUpdate:
    """Kalman update of a vector (3,) with a direct measurement, rejected beyond `gate` standard deviations.

    fast, slow: (3,3) covariance of its white and of its correlated noise.
    """
    off = measured - value
    if float(off @ np.linalg.solve(cov + fast + slow, off)) > gate * gate:
        return KalmanUpdate(value, cov, cov, np.zeros((3, 3)), False)
    gain = cov @ np.linalg.inv(cov + fast + slow)
    left = np.eye(3) - gain
    lasting = left @ cov @ left.T + gain @ slow @ gain.T
    return KalmanUpdate(value + gain @ off, lasting + gain @ fast @ gain.T, lasting, gain, True)

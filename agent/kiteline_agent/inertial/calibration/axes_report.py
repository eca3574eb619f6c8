"""What was found of a sensor's axes, in words and numbers."""

from typing import Any

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3


def measured_rotation(matrix: F64) -> tuple[F64, F64]:
    """What an IMU does, measured = matrix @ true, and its rotation vector (3,), for the correction `matrix` (3,3)."""
    measured = np.asarray(np.linalg.inv(matrix), np.float64)
    u, _, vt = np.linalg.svd(measured)
    return measured, se3.so3_log(u @ vt)


def correction_event(sensor: str, matrix: F64) -> str:
    """A line for the log when a sensor's samples are corrected by `matrix` (3,3) from now on."""
    measured, rotation = measured_rotation(matrix)
    scale, angle = 100.0 * float(np.abs(np.diag(measured) - 1.0).max()), np.degrees(np.linalg.norm(rotation))
    return f"{sensor}: scale off by up to {scale:.1f} %, camera rotated by {angle:.2f} degrees against it: corrected"


def axes_report(matrix: F64, cov: F64, *, applied: bool) -> dict[str, Any]:
    """Numbers of the correction `matrix` (3,3) with the covariance (9,9) of its elements: measured = matrix @ true."""
    measured, _ = measured_rotation(matrix)
    sigma = np.sqrt(np.diag(cov)).reshape(3, 3)
    return {
        "applied": applied,
        "scale": np.diag(measured).round(5).tolist(),
        "matrix": measured.round(5).tolist(),
        "sigma": sigma.round(5).tolist(),
    }


def turned_rad(matrix: F64, cov: F64, misalignment_sigma: float) -> float:
    """Size of the rotation in the correction `matrix` (3,3), rad. cov: (9,9) of its elements.

    Its square is weighted with the probability that there is one at all, by the Bayes factor of a rotation as large as
    misalignment_sigma allows against none.
    """
    turned = 0.5 * np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    j = np.zeros((3, 9))
    j[0, [7, 5]], j[1, [2, 6]], j[2, [3, 1]] = [0.5, -0.5], [0.5, -0.5], [0.5, -0.5]
    own = j @ cov @ j.T
    log_factor = 0.5 * float(turned @ np.linalg.solve(own, turned))
    log_factor += 0.5 * float(np.linalg.slogdet(own)[1]) - 1.5 * float(np.log(0.5 * misalignment_sigma**2))
    probability = 1.0 / (1.0 + float(np.exp(-np.clip(log_factor, -50.0, 50.0))))
    return float(np.sqrt(probability * (turned @ turned)))

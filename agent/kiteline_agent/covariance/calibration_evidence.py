"""How far the calibration of the cameras is off, by the residuals of tracked landmarks over a flight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.covariance.calibration_error_kernels import CALIBRATION

F64 = NDArray[np.float64]

_WORN = 5.0  # errors of a worn calibration over those of a good one: a quarter of a pixel at the image's edge
_SEEN = 0.3  # share of an error that residuals show: depths of landmarks, measured with it, hide the rest
_INFLATION = 16.0  # of variance: errors of templates and points are correlated over frames
_CLEAR = 15.0  # natural logarithm of the likelihood of such errors over that of none, above which they are there
_EVERY = 4  # frames between two tests


class CalibrationEvidence:
    """Tells whether the cameras have changed since their calibration.

    An error of the calibration leaves residuals that repeat from frame to frame, as a landmark moves through the image
    and comes nearer. Their likelihood, with the errors themselves integrated out, is that of a linear Gaussian model
    (D. MacKay, "Bayesian interpolation", 1992).
    """

    def __init__(self, variance: F64) -> None:
        """variance: (10,) px^2 of the errors of a good calibration, 0 for those that it does not have."""
        self._used = np.flatnonzero(variance > 0.0)
        self._variance = variance[self._used]
        self._information, self._side = np.zeros((CALIBRATION, CALIBRATION)), np.zeros(CALIBRATION)
        self._frames = 0
        self.level = 1.0  # standard deviation over that of a good calibration

    def add(self, h: F64, g: F64, of_errors: F64, side: F64) -> bool:
        """Add a frame, as calibration_error_kernels.sensitivity describes it. Returns True if the level changed."""
        to_pose = np.linalg.solve(h + 1e-6 * np.eye(6), g[:, :CALIBRATION]).T
        self._information += (of_errors - to_pose @ g[:, :CALIBRATION]) / _INFLATION
        self._side += (side[6:] - to_pose @ side[:6]) / _INFLATION
        self._frames += 1
        if self.level > 1.0 or self._frames % _EVERY or not self.log_likelihood > _CLEAR:
            return False
        self.level = _WORN
        return True

    @property
    def log_likelihood(self) -> float:
        """Of the residuals with errors of a worn calibration, over that without any."""
        information, side = self._information[np.ix_(self._used, self._used)], self._side[self._used]
        deviation = _SEEN * _WORN * np.sqrt(self._variance)
        scaled = np.eye(len(side)) + deviation[:, None] * information * deviation
        y = deviation * side
        return 0.5 * float(y @ np.linalg.solve(scaled, y)) - 0.5 * float(np.linalg.slogdet(scaled)[1])

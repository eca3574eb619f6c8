"""How far the calibration of the cameras is off, by the residuals of tracked landmarks over a flight."""

import numpy as np

from kiteline_agent.covariance.calibration_error_kernels import CALIBRATION, DISPARITY_SHAPES
from kiteline_core.arrays import F64

_WORN = 5.0  # errors of a worn calibration over those of a good one: a quarter of a pixel at the image's edge
_SEEN = 0.3  # share of an error that residuals show: depths of landmarks, measured with it, hide the rest
_INFLATION = 16.0  # of variance: errors of templates and points are correlated over frames
_CLEAR = 15.0  # natural logarithm of the likelihood of errors over that of none, above which they are there
_GOOD_PX, _WORN_PX = 0.08, 0.16  # error of the disparity that residuals show with a good and a worn calibration
_EVERY = 4  # frames between two tests


class CalibrationEvidence:
    """Tells whether the cameras have changed since their calibration.

    An error of the calibration leaves residuals that repeat from frame to frame, as a landmark moves through the image
    and comes nearer. Their likelihood, with the errors themselves integrated out, is that of a linear Gaussian model
    (D. MacKay, "Bayesian interpolation", 1992).
    """

    def __init__(self, variance: F64) -> None:
        """variance: (10,) px^2 of the errors of a good calibration, 0 of the disparity with one camera."""
        self._variance = variance
        self._information, self._side = np.zeros((CALIBRATION, CALIBRATION)), np.zeros(CALIBRATION)
        self._frames = 0
        self.level = 1.0  # standard deviation over that of a good calibration

    def add(self, h: F64, g: F64, of_errors: F64, side: F64) -> bool:
        """Add a frame, as calibration_error_kernels.sensitivity describes it. Returns True if the level changed."""
        if not self._variance[0] > 0.0:
            return False
        to_pose = np.linalg.solve(h + 1e-6 * np.eye(6), g[:, :CALIBRATION]).T
        self._information += (of_errors - to_pose @ g[:, :CALIBRATION]) / _INFLATION
        self._side += (side[6:] - to_pose @ side[:6]) / _INFLATION
        self._frames += 1
        if self._frames % _EVERY:
            return False
        before, self.level = self.level, self._level()
        return self.level != before

    def _level(self) -> float:
        """From 1 for a good calibration to that of a worn one, by the error of the disparity that residuals show."""
        found, cov, log_likelihood = self.found()
        if log_likelihood < _CLEAR:
            return 1.0
        square = float(np.sum(found[:DISPARITY_SHAPES] ** 2) - np.trace(cov[:DISPARITY_SHAPES, :DISPARITY_SHAPES]))
        share = (np.sqrt(max(square, 0.0)) - _GOOD_PX) / (_WORN_PX - _GOOD_PX)
        return float(np.clip(1.0 + (_WORN - 1.0) * share, 1.0, _WORN))

    def found(self) -> tuple[F64, F64, float]:
        """Errors (10,) in px that residuals show, their covariance (10,10), and the logarithm of their likelihood over
        that of none.
        """
        deviation = _SEEN * _WORN * np.sqrt(self._variance)
        scaled = np.eye(CALIBRATION) + deviation[:, None] * self._information * deviation
        cov = deviation[:, None] * np.linalg.inv(scaled) * deviation
        errors = cov @ self._side
        return errors, cov, 0.5 * float(errors @ self._side) - 0.5 * float(np.linalg.slogdet(scaled)[1])


def good_covariance(variance: F64, roll: float, worn: float, information: F64) -> F64:
    """Covariance (10,10) px^2 of the errors of a good calibration.

    variance: (10,) of the errors before the flight. roll: share of that of disparities along y which the right camera's
    rows allow. worn: probability of a worn rig. information: (5,5) on which the map's disparity offset rests if the
    calibration is good: what the offset leaves is the posterior.
    """
    out = np.diag(variance)
    out[2, 2] *= roll
    if information.any():
        of_disparities = slice(0, DISPARITY_SHAPES)
        before = out[of_disparities, of_disparities]
        after = np.linalg.inv(np.linalg.inv(before) + information)
        out[of_disparities, of_disparities] = worn * before + (1.0 - worn) * after
    return out

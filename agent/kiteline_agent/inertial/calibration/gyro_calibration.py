"""Time offset, bias, scale and axes of the gyro, from rotations by images over short windows."""

import numpy as np

from kiteline_agent.inertial.calibration.disagreement import Disagreement
from kiteline_agent.inertial.calibration.robust_update import AxesFilter, robust_update
from kiteline_agent.inertial.calibration.window import Window
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_AXES, _OFFSET, _BIAS = slice(0, 9), 9, slice(10, 13)
_BIAS_RAD_S = 0.1  # standard deviation of an unknown bias


class GyroCalibration(AxesFilter):
    """Kalman filter over [axes (9), time offset s, bias (3)]: rate = (1 + axes) @ gyro - bias.

    Axes are those of the body as the camera's extrinsics define them, so a rotation of the camera against the IMU is
    the antisymmetric part of `axes`. Shifting a window by d rotates the gyro's rotation by d (rate at its end - rotated
    rate at its start), after M. Li, A. Mourikis, "Online temporal calibration for camera-IMU systems", 2014.
    """

    BIAS = _BIAS

    def __init__(
        self, axes_sigma: F64, offset_sigma_s: float, offset_s: float, walk_rad_s2: float, disagreement: Disagreement
    ) -> None:  # fmt: skip
        """axes_sigma (9,), offset_sigma_s: of the calibration. offset_s: calibrated. walk_rad_s2: of the bias."""
        self.disagreement = disagreement
        self._x = np.zeros(13)
        self._x[_OFFSET] = offset_s
        self._cov = np.diag(np.concatenate([axes_sigma, [offset_sigma_s], np.full(3, _BIAS_RAD_S)]) ** 2)
        self._walk = np.repeat([1e-5, 1e-4, walk_rad_s2], [9, 1, 3]) ** 2
        self.excess = 0.0
        self.log_likelihood = 0.0  # natural logarithm, of all rotations as they were predicted

    def begin_with(self, axes: F64, axes_sigma: F64, offset_s: float, offset_sigma_s: float) -> None:
        """Begin with axes (3,3) and a time offset that earlier flights found, and their deviations."""
        self._x[_AXES], self._x[_OFFSET] = (axes - np.eye(3)).ravel(), offset_s
        sigma = np.concatenate([axes_sigma.ravel(), [offset_sigma_s]])
        self._cov[:10, :10] = np.diag(np.minimum(sigma**2, np.diag(self._cov)[:10]))

    def begin_with_offset(self, offset_s: float, sigma_s: float) -> None:
        """Begin with a time offset that was found otherwise, and its deviation."""
        self._x[_OFFSET] = offset_s
        self._cov[_OFFSET], self._cov[:, _OFFSET] = 0.0, 0.0
        self._cov[_OFFSET, _OFFSET] = sigma_s**2

    def set_bias(self, bias: F64) -> None:
        """Begin with a bias (3,) rad/s."""
        self._x[_BIAS] = bias

    @property
    def offset_s(self) -> float:
        """Camera stamp + offset = IMU time."""
        return float(self._x[_OFFSET])

    @property
    def offset_sigma_s(self) -> float:
        """Standard deviation of the offset."""
        return float(np.sqrt(self._cov[_OFFSET, _OFFSET]))

    def add(self, window: Window, R_b0_b1: F64, turn_variance: float, offset_s: float) -> float:
        """Add a window over which the images rotated by R_b0_b1 (3,3).

        window: integrated with the present matrix and bias. turn_variance: rad^2 of an axis, of images and gyro.
        offset_s: at which the window was cut. Returns the variance of the predicted rotation about an axis, rad^2.
        """
        back = window.turn.T
        j = np.empty((3, 13))
        j[:, _AXES] = back @ window.by_rate
        j[:, _OFFSET] = window.last_rate - back @ window.first_rate
        j[:, _BIAS] = -back @ window.time[0]
        turned = se3.so3_log(back @ R_b0_b1)
        self.disagreement.add(se3.so3_log(R_b0_b1), turned, turn_variance, window.duration_s)
        error = turned - j[:, _OFFSET] * (self._x[_OFFSET] - offset_s)
        self._cov[np.diag_indices(13)] += self._walk * window.duration_s
        update = robust_update(j, self._cov, error, turn_variance)
        self._count_excess(update.square)
        self.log_likelihood += update.log_likelihood
        self._x += update.gain @ error
        self._cov -= update.gain @ update.s @ update.gain.T
        self._cov = 0.5 * (self._cov + self._cov.T)
        return float(np.trace(update.predicted)) / 3.0

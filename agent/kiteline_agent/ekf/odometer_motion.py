"""The camera's motion between two frames, and its error, by an odometer's samples."""

import numpy as np

from kiteline_agent.ekf.filter_state import OdometryMotion
from kiteline_agent.ekf_config import EkfConfig
from kiteline_agent.motion.odometer_samples import MeanVelocity, OdometerSamples
from kiteline_core.arrays import F64
from kiteline_core.frame import OdometryBatch
from kiteline_core.geometry import se3

_MEASURED = 100.0  # (m/s)^2 or (rad/s)^2: any measured direction is far more precise
_TURN_SHARE = 0.02  # rad per sqrt(rad) turned: error of the heading
_IDLE_M_S = 0.005  # m per sqrt(s): the error of a vehicle that stands
_IDLE_RAD_S = 0.001  # rad per sqrt(s): the same of the heading
_UNMEASURED_M_S = 0.02  # m/s: velocity along axes that the odometer does not measure: wheels do not slide sideways
_UNMEASURED_RAD_S = 0.2  # rad/s: the same about axes that it does not measure
_GAP_M_S = 1.0  # m/s by which the velocity may have changed where samples are missing
_GAP_RAD_S = 0.5  # rad/s: the same of the rotation rate


class OdometerMotion:
    """Buffers samples, and continues with the last velocity where they have a gap."""

    def __init__(self, T_b_c: F64, config: EkfConfig, keep_s: float, max_gap_s: float) -> None:
        """keep_s, max_gap_s: as in OdometerConfig."""
        self._T_b_c, self._config = T_b_c, config
        self._samples = OdometerSamples(keep_s, max_gap_s)
        self._last = np.zeros(6)  # velocity and rate of the last interval, in b
        self.measured = False  # the last motion was

    def add(self, batch: OdometryBatch | None) -> None:
        """Take samples."""
        self._samples.add(batch)

    def between(self, from_ns: int, to_ns: int) -> OdometryMotion:
        """The camera's motion between two frames."""
        dt_s, mean = (to_ns - from_ns) * 1e-9, self._samples.between(from_ns, to_ns)
        self.measured = mean is not None
        if mean is not None:
            self._last = np.concatenate([mean.velocity, mean.rate])
        twist = dt_s * self._last
        T_b0_b1 = se3.exp(twist)
        way, turned = float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))
        return camera_motion(T_b0_b1, self._covariance(mean, dt_s, way, turned), self._T_b_c)

    def extrapolated(self, dt_s: float) -> F64:
        """Motion (4,4) of the body in dt_s after the last frame."""
        return se3.exp(dt_s * self._last)

    @property
    def twist(self) -> F64:
        """The last velocity and rate (6,) in b: m/s, rad/s."""
        return self._last

    def _covariance(self, mean: MeanVelocity | None, dt_s: float, way: float, turned: float) -> F64:
        """Of the body's motion (6,6): translation along the axes of b0, rotation about those of b1."""
        c = self._config
        out = np.zeros((6, 6))
        by_way = c.path_noise**2 * way + _IDLE_M_S**2 * dt_s
        by_turn = c.turn_noise**2 * way + _TURN_SHARE**2 * turned + _IDLE_RAD_S**2 * dt_s
        out[:3, :3], out[3:, 3:] = by_way * np.eye(3), by_turn * np.eye(3)
        if mean is None:
            out[:3, :3] += (_GAP_M_S * dt_s) ** 2 * np.eye(3)
            out[3:, 3:] += (_GAP_RAD_S * dt_s) ** 2 * np.eye(3)
            return out
        out[:3, :3] += dt_s**2 * _bounded(mean.velocity_cov, _UNMEASURED_M_S)
        out[3:, 3:] += dt_s**2 * _bounded(mean.rate_cov, _UNMEASURED_RAD_S)
        return out


def _bounded(cov: F64, sigma: float) -> F64:
    """Covariance (3,3) of samples; along axes that are not measured that of a vehicle which hardly moves so."""
    diagonal = np.diagonal(cov)
    if (diagonal < _MEASURED).all():
        return cov
    return np.diag(np.where(diagonal < _MEASURED, diagonal, sigma**2))


def camera_motion(T_b0_b1: F64, cov: F64, T_b_c: F64) -> OdometryMotion:
    """The camera's motion by that of the body. cov: (6,6) of the white error, along b0's axes and about b1's."""
    T_c_b = se3.inverse(T_b_c)
    R_c_b = T_c_b[:3, :3]
    # t_c = R_cb (t_b + R_b0_b1 arm - arm): a turn error w of the body adds R_cb R_b0_b1 (w x arm).
    to_camera = np.zeros((6, 6))
    to_camera[:3, :3] = to_camera[3:, 3:] = R_c_b
    to_camera[:3, 3:] = -R_c_b @ T_b0_b1[:3, :3] @ se3.skew(T_b_c[:3, 3])
    return OdometryMotion(T_c_b @ T_b0_b1 @ T_b_c, R_c_b @ T_b0_b1[:3, 3], to_camera @ cov @ to_camera.T)

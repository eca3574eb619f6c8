"""What the IMU tells the tracker: which way is up at the start, how far it has turned since the last frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core import se3
from kiteline_core.frame import ImuBatch

F64 = NDArray[np.float64]

_BIAS_GAIN = 0.02  # share of the disagreement with vision that goes into the gyro bias at each frame
_MAX_BIAS_RAD_S = 0.3  # beyond it the disagreement is not a bias
_MAX_GAP_S = 0.05  # a hole in the samples longer than this makes the turn unknown


def level_rotation(accel: F64) -> F64:
    """R_m_b (3,3) with z up and yaw zero, from the mean specific force (3,) in the body, which points up at rest."""
    up = accel / np.linalg.norm(accel)
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(up, z)
    s, c = float(np.linalg.norm(axis)), float(up @ z)
    if s < 1e-9:
        return np.eye(3) if c > 0 else np.diag([1.0, -1.0, -1.0])
    return se3.so3_exp(axis / s * np.arctan2(s, c))


class GyroPreintegrator:
    """Turns between frames from gyro samples, with a bias that vision corrects slowly."""

    def __init__(self) -> None:
        self.bias = np.zeros(3)  # rad/s
        self._last_t_ns: int | None = None
        self._last_gyro = np.zeros(3)
        self._resting: list[F64] = []

    def turn(self, imu: ImuBatch | None, from_ns: int, to_ns: int) -> F64 | None:
        """R_b0_b1 (3,3) between two instants by midpoint integration; None where samples are missing."""
        if imu is None or len(imu.t_ns) == 0:
            return None
        t = np.concatenate([[from_ns], imu.t_ns[(imu.t_ns > from_ns) & (imu.t_ns < to_ns)], [to_ns]]).astype(np.float64)
        if np.max(np.diff(t)) > _MAX_GAP_S * 1e9:
            return None
        known_t = imu.t_ns.astype(np.float64)
        known = imu.gyro
        if self._last_t_ns is not None and self._last_t_ns < imu.t_ns[0]:
            known_t = np.concatenate([[float(self._last_t_ns)], known_t])
            known = np.vstack([self._last_gyro, known])
        rates = np.column_stack([np.interp(t, known_t, known[:, a]) for a in range(3)]) - self.bias
        r = np.eye(3)
        for k in range(len(t) - 1):
            r = r @ se3.so3_exp(0.5 * (rates[k] + rates[k + 1]) * (t[k + 1] - t[k]) * 1e-9)
        return r

    def remember(self, imu: ImuBatch | None) -> None:
        """Keep the last sample, so that the next turn begins without a hole."""
        if imu is not None and len(imu.t_ns):
            self._last_t_ns, self._last_gyro = int(imu.t_ns[-1]), imu.gyro[-1]

    def correct(self, measured_R_b0_b1: F64, gyro_R_b0_b1: F64, dt_s: float) -> None:
        """Move the bias toward what makes the gyro agree with a turn that vision measured."""
        error = se3.so3_log(measured_R_b0_b1.T @ gyro_R_b0_b1) / dt_s
        if np.linalg.norm(error) < _MAX_BIAS_RAD_S:
            self.bias = self.bias + _BIAS_GAIN * error

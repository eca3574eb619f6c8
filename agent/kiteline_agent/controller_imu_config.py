"""Options for the IMU of a flight controller: its noise, and the pose of the camera."""

from dataclasses import dataclass, field

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

_RIGID = 1e-3  # tolerance of a rotation matrix for printed digits

# Measured noise of a small MEMS unit in flight: vibration exceeds the noise of its data sheet.
_FLYING = ImuCalibration(gyro_noise=1e-3, gyro_walk=5e-5, accel_noise=2e-2, accel_walk=3e-3)


@dataclass(frozen=True, slots=True)
class ControllerImuConfig:
    """Options of `--imu controller`."""

    T_f_c: tuple[float, ...] = ()  # row-major 4x4: left camera in the controller's FRD frame, m; (): from the source
    noise: ImuCalibration = field(default_factory=lambda: _FLYING)  # rate_hz: requested from the controller

    def __post_init__(self) -> None:
        if not 1.0 <= self.noise.rate_hz <= 2000.0:
            raise ValueError(f"noise.rate_hz is {self.noise.rate_hz:g}: expected samples a second, 1 to 2000")
        if not self.T_f_c:
            return
        t = np.array(self.T_f_c)
        rigid = t.size == 16 and np.isfinite(t).all() and np.array_equal(t[12:], [0.0, 0.0, 0.0, 1.0])
        r = t.reshape(4, 4)[:3, :3] if rigid else np.zeros((3, 3))
        if not rigid or np.abs(r.T @ r - np.eye(3)).max() > _RIGID or np.linalg.det(r) < 0.0:
            raise ValueError(
                "T_f_c is no rigid motion: expected 16 numbers, a rotation and metres in rows, the last 0 0 0 1"
            )

    def camera(self) -> F64 | None:
        """T_f_c (4,4); None if not configured."""
        return se3.orthonormalise(np.array(self.T_f_c).reshape(4, 4)) if self.T_f_c else None

"""What earlier flights found of an IMU, with deviations: the prior of the next flight."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64

_SIZES = {"offset_s": 2, "gyro": 9, "gyro_sigma": 9, "accel": 9, "accel_sigma": 9}
_MAX_OFFSET_S, _MAX_AXES = 0.5, 0.2  # beyond these no IMU was found, but something else is wrong


@dataclass(frozen=True, slots=True)
class KnownImuConfig:
    """Time offset and axes of an IMU as flights found them. A value as uncertain as before a flight says nothing.

    Biases are not among them: they differ at each power-on, and a flight finds them in a second.
    """

    offset_s: tuple[float, ...] = ()  # s; camera stamp + offset = IMU time, and its deviation; (): not known
    gyro: tuple[float, ...] = ()  # row-major 3x3; rate = gyro @ measured - bias, in the body's axes by the camera
    gyro_sigma: tuple[float, ...] = ()  # deviations of its elements
    accel: tuple[float, ...] = ()  # row-major 3x3; force = accel @ measured - bias, likewise
    accel_sigma: tuple[float, ...] = ()  # deviations of its elements

    def __post_init__(self) -> None:
        for name, size in _SIZES.items():
            values = getattr(self, name)
            if values and (len(values) != size or not np.isfinite(values).all()):
                raise ValueError(f"{name} has {len(values)} numbers: expected {size} finite ones, or none")
        if any(sigma <= 0.0 for sigma in (*self.offset_s[1:], *self.gyro_sigma, *self.accel_sigma)):
            raise ValueError("a deviation is not positive")
        if len(self.gyro) != len(self.gyro_sigma) or len(self.accel) != len(self.accel_sigma):
            raise ValueError("axes and their deviations belong together: expected both, or none")
        if any(abs(v) > _MAX_OFFSET_S for v in self.offset_s):
            raise ValueError(f"offset_s is in s: expected at most {_MAX_OFFSET_S:g}")
        for axes in (self.gyro, self.accel):
            if axes and not is_plausible(np.reshape(axes, (3, 3))):
                raise ValueError(f"axes differ from those of a true IMU by more than {_MAX_AXES:g}")


def is_plausible(matrix: F64, offset_s: float = 0.0) -> bool:
    """True if axes (3,3) and a time offset are of an IMU as KnownImuConfig may hold it."""
    return bool(np.abs(matrix - np.eye(3)).max() <= _MAX_AXES and abs(offset_s) <= _MAX_OFFSET_S)


def known_axes(matrix: F64, cov: F64) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Axes (3,3) and the deviations of their elements from their covariance (9,9), rounded."""
    sigma = np.sqrt(np.diag(cov))
    return tuple(round(float(v), 6) for v in matrix.ravel()), tuple(max(round(float(v), 6), 1e-6) for v in sigma)

"""What a sensor delivers: images at one instant, inertial samples, velocities of an odometer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """An image as its source holds it, so that a log can keep it without coding it again."""

    data: bytes
    format: str  # "png", "jpeg": what cv2.imdecode understands; depth "png/5000": 16-bit values / 5000 are metres


@dataclass(frozen=True, slots=True)
class Frame:
    """Images captured at one instant, as the lens made them (not yet rectified).

    left: (h, w) uint8 grey. right: the same of the right camera, or None.
    depth_m: (h, w) float32 metres aligned with `left`, 0 where unknown, or None.
    encoded: the bytes from which left (and right, or depth) were decoded, in that order, or ().
    """

    t_ns: int
    left: U8
    right: U8 | None = None
    depth_m: NDArray[np.float32] | None = None
    encoded: tuple[EncodedImage, ...] = ()


@dataclass(frozen=True, slots=True)
class ImuBatch:
    """Inertial samples in order of time, in the body frame.

    t_ns: (n,) int64, strictly increasing. gyro: (n, 3) rad/s. accel: (n, 3) m/s^2 (specific force: +9.8 up at rest).
    """

    t_ns: NDArray[np.int64]
    gyro: NDArray[np.float64]
    accel: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ImuCalibration:
    """Noise densities of an IMU whose axes are those of the body frame."""

    gyro_noise: float = 1.7e-4  # rad/s/sqrt(Hz)
    gyro_walk: float = 1.9e-5  # rad/s^2/sqrt(Hz)
    accel_noise: float = 2.0e-3  # m/s^2/sqrt(Hz)
    accel_walk: float = 3.0e-3  # m/s^3/sqrt(Hz)
    rate_hz: float = 200.0


UNMEASURED = 1e6  # variance, (m/s)^2 or (rad/s)^2, of a direction in which an odometer measures nothing


@dataclass(frozen=True, slots=True)
class OdometryBatch:
    """Velocities that wheels or a flight controller measured, in order of time, of the body frame's origin and in the
    axes of the body frame (whatever axes and place the device has: its source turns them, `odometry.in_body`).

    t_ns: (n,) int64, strictly increasing. velocity: (n, 3) m/s. rate: (n, 3) rad/s, how the body turns. velocity_cov,
    rate_cov: (n, 3, 3), (m/s)^2 and (rad/s)^2, with the variance UNMEASURED (or more) in directions in which nothing is
    measured: the value along them says nothing.
    """

    t_ns: NDArray[np.int64]
    velocity: NDArray[np.float64]
    rate: NDArray[np.float64]
    velocity_cov: NDArray[np.float64]
    rate_cov: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time. t_ns: (n,) int64 strictly increasing. T_w_b: (n, 4, 4) float64."""

    t_ns: NDArray[np.int64]
    T_w_b: NDArray[np.float64]

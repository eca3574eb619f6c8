"""Sensor data: images at one instant, IMU samples, odometer velocities."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F32, F64, I64, U8, Bool


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """An encoded image from a source, so that a log can store it without encoding it again."""

    data: bytes
    format: str  # "png", "jpeg": what cv2.imdecode understands; depth "png/5000": 16-bit values / 5000 are metres


@dataclass(frozen=True, slots=True)
class Frame:
    """Images captured at one instant, not rectified.

    left: (h, w) uint8 grey. right: the same of the right camera, or None.
    depth_m: (h, w) float32 metres aligned with `left`, 0 where unknown, or None.
    encoded: the bytes from which left (and right, or depth) were decoded, in that order, or ().
    """

    t_ns: int
    left: U8
    right: U8 | None = None
    depth_m: F32 | None = None
    encoded: tuple[EncodedImage, ...] = ()


@dataclass(frozen=True, slots=True)
class ImuBatch:
    """IMU samples in order of time, in the body frame.

    t_ns: (n,) int64, strictly increasing. gyro: (n, 3) rad/s. accel: (n, 3) m/s^2 (specific force: +9.8 up at rest).
    """

    t_ns: I64
    gyro: F64
    accel: F64


@dataclass(frozen=True, slots=True)
class ImuCalibration:
    """Noise densities of an IMU whose axes are those of the body frame."""

    gyro_noise: float = 1.7e-4  # rad/s/sqrt(Hz)
    gyro_walk: float = 1.9e-5  # rad/s^2/sqrt(Hz)
    accel_noise: float = 2.0e-3  # m/s^2/sqrt(Hz)
    accel_walk: float = 3.0e-3  # m/s^3/sqrt(Hz)
    rate_hz: float = 200.0  # samples a second that the IMU delivers


UNMEASURED = 1e6  # variance, (m/s)^2 or (rad/s)^2, of a direction that an odometer does not measure


@dataclass(frozen=True, slots=True)
class OdometryBatch:
    """Velocities by wheels or a flight controller, in order of time, of the body frame's origin and in its axes.

    Sources convert from the frame of the device (`odometry.in_body`).

    t_ns: (n,) int64, strictly increasing. velocity: (n, 3) m/s. rate: (n, 3) rad/s of the body. velocity_cov,
    rate_cov: (n, 3, 3), (m/s)^2 and (rad/s)^2, with variance UNMEASURED or more in unmeasured directions, in which the
    value is meaningless.
    """

    t_ns: I64
    velocity: F64
    rate: F64
    velocity_cov: F64
    rate_cov: F64


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time. t_ns: (n,) int64 strictly increasing. T_w_b: (n, 4, 4) float64."""

    t_ns: I64
    T_w_b: F64


def chosen(batch: ImuBatch, which: I64 | Bool | slice) -> ImuBatch:
    """Some samples of a batch, by their numbers or flags."""
    return ImuBatch(batch.t_ns[which], batch.gyro[which], batch.accel[which])


def joined(batches: Sequence[ImuBatch]) -> ImuBatch | None:
    """IMU batches concatenated; None if there are none."""
    if len(batches) < 2:
        return batches[0] if batches else None
    return ImuBatch(
        np.concatenate([batch.t_ns for batch in batches]),
        np.concatenate([batch.gyro for batch in batches]),
        np.concatenate([batch.accel for batch in batches]),
    )

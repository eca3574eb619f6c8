"""Preintegration of IMU samples between two instants, with covariance and bias Jacobians."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial import imu_kernels
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3


@dataclass(frozen=True, slots=True)
class Samples:
    """IMU samples between two instants, both included.

    t_s: (n,) s from the first. gyro, accel: (n,3). density: (n-1,2) measured noise density of each step, gyro and
    accelerometer, per square root of Hz; None: not measured.
    """

    t_s: F64
    gyro: F64
    accel: F64
    density: F64 | None = None

    @property
    def duration_s(self) -> float:
        """Time between the two instants."""
        return float(self.t_s[-1])


@dataclass(frozen=True, slots=True)
class BiasPrior:
    """Biases (6,) [gyro rad/s, accel m/s^2] known before, and their deviations (6,)."""

    bias: F64
    sigma: F64


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """Camera stamp + offset_s = IMU time. sigma_s: its standard deviation."""

    offset_s: float
    sigma_s: float


@dataclass(frozen=True, slots=True)
class Preintegrated:
    """Relative motion in the body frame of the first instant, without gravity.

    turn: (3,3) R_b0_b1. vp: (6,) change of velocity m/s, of position m. cov: (9,9) of [rotation, velocity, position],
    rotation perturbed on the right. jac: (9,6) of the same by [gyro bias, accel bias]. bias: (6,) that was subtracted.
    """

    dt_s: float
    turn: F64
    vp: F64
    cov: F64
    jac: F64
    bias: F64

    def corrected(self, bias: F64) -> tuple[F64, F64]:
        """turn (3,3) and vp (6,) for another bias (6,), to first order."""
        d = bias - self.bias
        return self.turn @ se3.so3_exp(self.jac[:3, :3] @ d[:3]), self.vp + self.jac[3:] @ d

    def propagate(self, T_m_b: F64, velocity: F64, bias: F64, gravity: F64) -> tuple[F64, F64]:
        """Pose (4,4) and velocity (3,) at the second instant from those at the first. gravity: (3,) m/s^2 in m."""
        turn, vp = self.corrected(bias)
        r = T_m_b[:3, :3]
        dt = self.dt_s
        position = T_m_b[:3, 3] + velocity * dt + 0.5 * gravity * dt * dt + r @ vp[3:]
        return se3.from_rt(r @ turn, position), velocity + gravity * dt + r @ vp[:3]


def preintegrate(samples: Samples, bias: F64, calibration: ImuCalibration, inflation: float = 1.0) -> Preintegrated:
    """Integrate samples after subtracting a bias (6,) [gyro, accel].

    inflation: factor on the calibrated noise densities. Measured densities replace them where they are larger.
    """
    turn, vp, cov, jac = np.empty((3, 3)), np.empty(6), np.empty((9, 9)), np.empty((9, 6))
    density = np.empty((len(samples.t_s) - 1, 2))
    density[:] = calibration.gyro_noise * inflation, calibration.accel_noise * inflation
    if samples.density is not None:
        density = np.maximum(density, samples.density)
    imu_kernels.preintegrate(samples.t_s, samples.gyro, samples.accel, bias, density, turn, vp, cov, jac)
    return Preintegrated(samples.duration_s, turn, vp, cov, jac, bias.copy())

"""Preintegration of IMU samples between two instants, with covariance and bias Jacobians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.inertial import imu_kernels
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Samples:
    """IMU samples between two instants, both included. t_s: (n,) s from the first. gyro, accel: (n,3)."""

    t_s: F64
    gyro: F64
    accel: F64

    @property
    def duration_s(self) -> float:
        """Time between the two instants."""
        return float(self.t_s[-1])


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
    """Integrate samples after subtracting a bias (6,) [gyro, accel]. inflation: factor on the noise densities."""
    turn, vp, cov, jac = np.empty((3, 3)), np.empty(6), np.empty((9, 9)), np.empty((9, 6))
    density = np.array([calibration.gyro_noise, calibration.accel_noise]) * inflation
    imu_kernels.preintegrate(samples.t_s, samples.gyro, samples.accel, bias, density, turn, vp, cov, jac)
    return Preintegrated(samples.duration_s, turn, vp, cov, jac, bias.copy())


class SampleBuffer:
    """The newest IMU samples in order of time."""

    def __init__(self, keep_s: float, max_gap_s: float) -> None:
        """keep_s: length of the buffer. max_gap_s: a longer gap makes an interval unknown."""
        self._keep_ns = int(keep_s * 1e9)
        self._gap_ns = int(max_gap_s * 1e9)
        self._t: I64 = np.zeros(0, np.int64)
        self._values = np.zeros((0, 6))

    def push(self, imu: ImuBatch | None) -> None:
        """Append samples that are finite and newer than the newest one."""
        if imu is None or len(imu.t_ns) == 0:
            return
        values = np.concatenate([imu.gyro, imu.accel], axis=1)
        newest = int(self._t[-1]) if len(self._t) else -(1 << 62)
        good = (imu.t_ns > newest) & np.isfinite(values).all(axis=1)
        t = np.concatenate([self._t, imu.t_ns[good]])
        if len(t) == 0:
            return
        first = int(np.searchsorted(t, t[-1] - self._keep_ns))
        self._t, self._values = t[first:], np.concatenate([self._values, values[good]])[first:]

    @property
    def newest_t_ns(self) -> int | None:
        """Time of the newest sample."""
        return int(self._t[-1]) if len(self._t) else None

    def between(self, from_ns: int, to_ns: int) -> Samples | None:
        """Samples from one instant to another, ends interpolated (held beyond the newest); None with a gap."""
        t = self._t
        if len(t) < 2 or to_ns <= from_ns:
            return None
        lo, hi = int(np.searchsorted(t, from_ns, "right")), int(np.searchsorted(t, to_ns, "left"))
        stamps = np.concatenate([[from_ns], t[lo:hi], [to_ns]])
        if from_ns < t[0] - self._gap_ns or to_ns > t[-1] + self._gap_ns or np.diff(stamps).max() > self._gap_ns:
            return None
        values = np.empty((hi - lo + 2, 6))
        values[1:-1] = self._values[lo:hi]
        values[0] = self._at(from_ns)
        values[-1] = self._at(to_ns)
        return Samples(
            (stamps - from_ns) * 1e-9, np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:])
        )

    def mean(self, from_ns: int, to_ns: int) -> tuple[F64, F64, int]:
        """Mean (6,) and standard deviation (6,) of the samples between two instants, and their number."""
        chosen = self._values[(self._t >= from_ns) & (self._t <= to_ns)]
        if len(chosen) == 0:
            return np.zeros(6), np.zeros(6), 0
        return chosen.mean(axis=0), chosen.std(axis=0), len(chosen)

    def _at(self, t_ns: int) -> F64:
        t = self._t
        k = int(np.searchsorted(t, t_ns))
        if k == 0 or k == len(t):
            return np.asarray(self._values[min(k, len(t) - 1)])
        share = (t_ns - int(t[k - 1])) / (int(t[k]) - int(t[k - 1]))
        return np.asarray((1.0 - share) * self._values[k - 1] + share * self._values[k])

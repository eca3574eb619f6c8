"""Scale of a monocular map in metres, watched while it is tracked: images give displacements, the IMU their length.

An iterated Kalman filter over [1 / scale, gravity, velocity, accelerometer bias]; rotations are known from images and
gyro. Neither displacements of images nor those of the IMU are free of noise, so that a linear regression of one on the
other would be biased: the update is linearised at the displacement that both give together.
"""

from dataclasses import replace

import numpy as np

from kiteline_agent.inertial.preintegration import Samples, preintegrate
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

_ITERATIONS = 3
_UNITS, _GRAVITY, _VELOCITY, _BIAS = 0, slice(1, 4), slice(4, 7), slice(7, 10)
_START_GRAVITY_M_S2 = 0.1  # m/s^2; deviation of gravity at the start
_START_VELOCITY_M_S = 0.1  # m/s; deviation of the velocity at the start
_START_BIAS_M_S2 = 0.1  # m/s^2; deviation of the accelerometer's bias at the start
_GRAVITY_SIGMA_M_S2 = 0.01  # m/s^2; of the length of gravity
_KNOWN_SIGMA = 0.025  # relative deviation below which the scale may be corrected
_LEAST = 0.015  # relative; smallest correction: each begins a new submap
_LEAST_DEVIATIONS = 1.1  # smallest correction in its own deviations
_LEAST_S = 4.0  # s between two corrections
_START_SCALE = 0.022  # relative deviation of the start's scale: that of a first window
_ACCEL_WALK = 0.02  # m/s^2 per sqrt(s): errors of scale and axes, of the map's rotations
MAP_WALK = 0.006  # per sqrt(s): the map's own scale drifts while it grows
_IMAGE_RAD = 7e-4  # rad; error of a position by images, over the depth that they see
_IMU_INFLATION = 3.0  # of the calibration's noise densities, beside the factor that the start found
_CHI2 = 16.27  # 99.9 % with 3 degrees of freedom: beyond it an interval is left out, the images jumped
INTERVAL_S = 0.39  # s between two compared poses, and of inertial steps: velocity changes more than images err


def correction_due(scale: float, sigma: float, age_s: float) -> tuple[float, float] | None:
    """Factor by which a map is to be scaled, and its deviation; None if it is right as far as is known.

    scale: metres per unit of the map. sigma: its deviation. age_s: since the map began, or was corrected.
    """
    if age_s < _LEAST_S or sigma > _KNOWN_SIGMA * scale:
        return None
    return (scale, sigma) if abs(np.log(scale)) > max(_LEAST, _LEAST_DEVIATIONS * sigma / scale) else None


class ScaleFilter:
    """Metres per unit of the map. Call `start`, then `add` with each interval."""

    def __init__(self, calibration: ImuCalibration, gravity_m_s2: float, p_b_c: F64) -> None:
        """p_b_c: (3,) m, camera in the body."""
        self._calibration = calibration
        self._length = gravity_m_s2
        self._p_b_c = p_b_c
        self._x = np.zeros(10)
        self._cov = np.eye(10)
        self._inflation = _IMU_INFLATION
        self.running = False
        self.age_s = 0.0  # since the start or the last correction of its own

    @property
    def scale(self) -> tuple[float, float]:
        """Metres per unit of the map, and the standard deviation."""
        q = max(float(self._x[_UNITS]), 1e-3)
        return 1.0 / q, float(np.sqrt(self._cov[_UNITS, _UNITS])) / q**2

    @property
    def deviation(self) -> float:
        """Relative deviation of lengths in the map as it is: how well the scale is known, and how far off it seems."""
        scale, sigma = self.scale
        return float(np.hypot(sigma, scale - 1.0))

    def correction(self) -> tuple[float, float] | None:
        """Factor by which the map is to be scaled, and its deviation; None if it is right as far as is known."""
        return correction_due(*self.scale, self.age_s) if self.running else None

    def stop(self) -> None:
        """Forget all: a map of another unit begins."""
        self.running = False

    def start(self, velocity: F64, gravity: F64, bias: F64, accel_noise: float) -> None:
        """Start with unit scale. velocity, gravity: (3,) in m. bias: (6,). accel_noise: factor on the white noise."""
        self._inflation = _IMU_INFLATION * max(accel_noise, 1.0)
        self._x = np.concatenate([[1.0], gravity, velocity, bias[3:]])
        sigma = np.repeat([_START_SCALE, _START_GRAVITY_M_S2, _START_VELOCITY_M_S, _START_BIAS_M_S2], [1, 3, 3, 3])
        self._cov = np.diag(sigma**2)
        self.running, self.age_s = True, 0.0

    def wait(self, dt_s: float) -> None:
        """Process a time in which nothing was compared: the map grew, and the bias moved."""
        self._walk(self._cov, dt_s)

    def resume(self, velocity: F64) -> None:
        """Continue after frames without images, at this velocity (3,) m/s in m."""
        self._x[_VELOCITY] = velocity
        self._cov[_VELOCITY], self._cov[:, _VELOCITY] = 0.0, 0.0
        self._cov[_VELOCITY, _VELOCITY] = _START_VELOCITY_M_S**2 * np.eye(3)

    def add(self, T_m_b0: F64, T_m_b1: F64, samples: Samples, gyro_bias: F64, depth_m: float) -> None:
        """Process an interval between two poses (4,4) by images, `depth_m` from what they see."""
        x = self._x
        samples = replace(samples, density=None)  # which is vibration, and averages out, and fast motion
        bias = np.concatenate([gyro_bias, x[_BIAS]])
        motion = preintegrate(samples, bias, self._calibration, self._inflation)
        r, dt = T_m_b0[:3, :3], motion.dt_s
        # predict the state, and behind it the displacement of the camera in metres
        f = np.zeros((13, 10))
        f[:10] = np.eye(10)
        f[_VELOCITY, _GRAVITY], f[_VELOCITY, _BIAS] = dt * np.eye(3), r @ motion.jac[3:6, 3:]
        f[10:, _GRAVITY], f[10:, _VELOCITY] = 0.5 * dt * dt * np.eye(3), dt * np.eye(3)
        f[10:, _BIAS] = r @ motion.jac[6:, 3:]
        lever = (T_m_b1[:3, :3] - r) @ self._p_b_c
        before = np.append(x, x[_VELOCITY] * dt + 0.5 * dt * dt * x[_GRAVITY] + r @ motion.vp[3:] + lever)
        before[_VELOCITY] += x[_GRAVITY] * dt + r @ motion.vp[:3]
        cov = f @ self._cov @ f.T
        rotate = np.kron(np.eye(2), r)
        both = np.r_[4:7, 10:13]
        cov[np.ix_(both, both)] += rotate @ motion.cov[3:, 3:] @ rotate.T
        self._walk(cov, dt)
        # update by the displacement that the images give, and by the length of gravity
        seen = (T_m_b1[:3, 3] + T_m_b1[:3, :3] @ self._p_b_c) - (T_m_b0[:3, 3] + r @ self._p_b_c)
        noise = np.diag(np.append(np.full(3, 2.0 * (_IMAGE_RAD * depth_m) ** 2), _GRAVITY_SIGMA_M_S2**2))
        self.age_s += dt
        now = before
        for _ in range(_ITERATIONS):  # at the updated displacement: noise of the prediction would bias the scale
            h = np.zeros((4, 13))
            h[:3, _UNITS], h[:3, 10:] = now[10:], now[_UNITS] * np.eye(3)
            length = float(np.linalg.norm(now[_GRAVITY]))
            h[3, _GRAVITY] = now[_GRAVITY] / length
            expected = np.append(now[_UNITS] * now[10:], length)
            off = np.append(seen, self._length) - expected - h @ (before - now)
            s = h @ cov @ h.T + noise
            gain = np.linalg.solve(s, h @ cov).T
            if float(off[:3] @ np.linalg.solve(s[:3, :3], off[:3])) > _CHI2:
                gain[:] = 0.0  # the images jumped
            now = before + gain @ off
        self._x = now[:10]
        cov = (cov - gain @ h @ cov)[:10, :10]
        self._cov = 0.5 * (cov + cov.T)

    def _walk(self, cov: F64, dt_s: float) -> None:
        """Add to a covariance what scale and bias move by in dt_s."""
        cov[_UNITS, _UNITS] += MAP_WALK**2 * dt_s
        cov[_BIAS, _BIAS] += (_ACCEL_WALK**2 + self._calibration.accel_walk**2) * dt_s * np.eye(3)

    def correct(self, factor: float) -> None:
        """The map was scaled by `factor`, which was found here: the next correction waits."""
        self.age_s = 0.0
        self.scale_map(factor)

    def scale_map(self, factor: float) -> None:
        """The map was scaled by `factor`."""
        self._x[_UNITS] *= factor
        self._cov[_UNITS] *= factor
        self._cov[:, _UNITS] *= factor

    def rotate_map(self, R_new_old: F64) -> None:
        """The map's axes were rotated."""
        q = np.eye(10)
        q[_GRAVITY, _GRAVITY], q[_VELOCITY, _VELOCITY] = R_new_old, R_new_old
        self._x, self._cov = q @ self._x, q @ self._cov @ q.T


def camera_scaled(T_m_b: F64, scale: float, p_b_c: F64, centre: F64 | None = None) -> F64:
    """T_m_b (4,4) after the map was scaled about a centre (3,): the camera's position scales.

    Its lever arm p_b_c (3,) does not. centre: None for the origin.
    """
    offset = T_m_b[:3, :3] @ p_b_c
    camera = T_m_b[:3, 3] + offset
    scaled = scale * camera if centre is None else centre + scale * (camera - centre)
    return se3.from_rt(T_m_b[:3, :3], scaled - offset)

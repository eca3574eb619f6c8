"""Bias, scale and axes of the accelerometer, the vertical and the scale of the images, from positions by images."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial.calibration.disagreement import Disagreement
from kiteline_agent.inertial.calibration.lever_search import LeverSearch
from kiteline_agent.inertial.calibration.pose_chain import SampledMotion
from kiteline_agent.inertial.calibration.robust_update import AxesFilter, robust_update
from kiteline_agent.inertial.calibration.window import Window
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_AXES, _BIAS, _TILT, _SCALE = slice(0, 9), slice(9, 12), slice(12, 15), 15
_BIAS_M_S2, _TILT_RAD = 0.1, 0.03  # standard deviations at the start
_TILT_WALK_RAD = 2e-4  # per sqrt(s): the map bends while it grows


@dataclass(frozen=True, slots=True)
class Move:
    """A window of motion. density: of the accelerometer's noise. position_m: error of a position by images. unsteady:
    factor on the variance of poses by images.
    """

    window: Window
    link: SampledMotion
    density: float
    position_m: float
    unsteady: float

    def variance_with(self, after: "Move", tilt_m_s2: float) -> float:
        """Variance in (m/s)^2 of the change of the mean velocity to the window after this one.

        tilt_m_s2: acceleration by an error of the rotation by images.
        """
        unsteady, position_m = max(self.unsteady, after.unsteady), max(self.position_m, after.position_m)
        t0, t1 = self.window.duration_s, after.window.duration_s
        images = position_m**2 * (1 / t0**2 + (1 / t0 + 1 / t1) ** 2 + 1 / t1**2)
        imu = (t0 * self.density**2 + t1 * after.density**2) / 3.0
        tilt = tilt_m_s2**2 * 0.5 * (t0**2 + t1**2)
        return images + imu + tilt + (unsteady - 1.0) * (images + tilt)


class AccelCalibration(AxesFilter):
    """Kalman filter over [axes (9), bias (3), tilt (3), scale]: force = (1 + axes) @ accel - bias.

    Two windows one after the other give the change of the mean velocity by images, which is the integral of the
    specific force, weighted by a hat over both, and of gravity: the velocity between them is not needed.
    """

    BIAS = _BIAS

    def __init__(
        self, axes_sigma: F64, scale_sigma: float, walk_m_s3: float, gravity_m_s2: float, disagreement: Disagreement
    ) -> None:  # fmt: skip
        """axes_sigma (9,), scale_sigma: of the calibration. walk_m_s3: of the bias, per sqrt(s)."""
        self.disagreement = disagreement
        self._gravity_m_s2 = gravity_m_s2
        self._x = np.zeros(16)
        others = np.repeat([_BIAS_M_S2, _TILT_RAD, scale_sigma], [3, 3, 1])
        self._cov = np.diag(np.concatenate([axes_sigma, others]) ** 2)
        self._walk = np.repeat([1e-5, walk_m_s3, _TILT_WALK_RAD, 1e-4], [9, 3, 3, 1]) ** 2
        self._gravity: F64 | None = None
        self.excess = 0.0

    def begin_with(self, axes: F64, axes_sigma: F64) -> None:
        """Begin with axes (3,3) that earlier flights found, and the deviations of their elements."""
        self._x[_AXES] = (axes - np.eye(3)).ravel()
        self._cov[_AXES, _AXES] = np.diag(np.minimum(axes_sigma.ravel() ** 2, np.diag(self.axes_cov)))

    @property
    def scale(self) -> tuple[float, float]:
        """Metres per metre of the images, and its standard deviation."""
        return 1.0 + float(self._x[_SCALE]), float(np.sqrt(self._cov[_SCALE, _SCALE]))

    def set_vertical(self, gravity: F64 | None) -> None:
        """Begin in a map in which gravity points along (3,); None: unknown as yet."""
        self._gravity = None if gravity is None else self._gravity_m_s2 * gravity / np.linalg.norm(gravity)
        self._cov[_TILT, :] = self._cov[:, _TILT] = 0.0
        self._cov[_TILT, _TILT] = _TILT_RAD**2 * np.eye(3)

    @property
    def has_vertical(self) -> bool:
        """True if gravity in the map is known."""
        return self._gravity is not None

    def continue_map(self, other: "AccelCalibration") -> None:
        """Take over the vertical of another filter in the same map."""
        self._gravity = other._gravity

    def rotate_map(self, R_new_old: F64) -> None:
        """Rotate gravity with the map by R_new_old (3,3)."""
        if self._gravity is not None:
            self._gravity = R_new_old @ self._gravity
            self._cov[_TILT, :] = R_new_old @ self._cov[_TILT, :]
            self._cov[:, _TILT] = self._cov[:, _TILT] @ R_new_old.T

    def add(
        self, windows: tuple[Window, Window], T_m_b: tuple[F64, F64, F64], p_b_c: F64, variance: float,
        search: LeverSearch,
    ) -> None:  # fmt: skip
        """Add two windows with the poses (4,4) at their ends.

        p_b_c: (3,) m, camera in the body. variance: (m/s)^2 of the change of velocity, of images and IMU.
        search: gets the same windows.
        """
        if self._gravity is None:
            return
        first, second = windows
        r = [T[:3, :3] for T in T_m_b]
        camera = [T[:3, 3] + T[:3, :3] @ p_b_c for T in T_m_b]
        dt = first.duration_s, second.duration_s
        moved = (camera[2] - camera[1]) / dt[1] - (camera[1] - camera[0]) / dt[0]
        lever = (r[2] - r[1]) @ p_b_c / dt[1] - (r[1] - r[0]) @ p_b_c / dt[0]
        by_lever = (r[2] - r[1]) / dt[1] - (r[1] - r[0]) / dt[0]
        force = r[0] @ first.by_force[1] + r[1] @ (second.by_force[0] - second.by_force[1])
        time = r[0] @ first.time[1] + r[1] @ (second.time[0] - second.time[1])
        fallen = 0.5 * (dt[0] + dt[1]) * self._gravity
        x = self._x
        error = (1.0 + x[_SCALE]) * moved - lever - fallen - force @ self.matrix.ravel() + time @ x[_BIAS]
        self.disagreement.add(moved, error, variance, dt[1])
        search.add(by_lever, 0.5 * (dt[0] + dt[1]), -time, moved - lever - force @ self.matrix.ravel(), dt[1])
        j = np.empty((3, 16))  # of the negative error
        j[:, _AXES], j[:, _BIAS], j[:, _TILT], j[:, _SCALE] = force, -time, -se3.skew(fallen), -moved
        self._cov[np.diag_indices(16)] += self._walk * dt[1]
        update = robust_update(j, self._cov, error, variance)
        self._count_excess(update.square)
        change = update.gain @ error
        self._gravity = se3.so3_exp(change[_TILT]) @ self._gravity
        change[_TILT] = 0.0
        self._x = x + change
        self._cov -= update.gain @ update.s @ update.gain.T
        self._cov = 0.5 * (self._cov + self._cov.T)

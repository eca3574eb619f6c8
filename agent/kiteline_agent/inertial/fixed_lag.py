"""A tightly coupled smoother over the last few frames: poses, velocities, biases and gravity from images and IMU.

Points are fixed, with their own depth uncertainty. States that leave the window become a dense prior on the oldest
remaining state, linearised once (S. Leutenegger et al., "Keyframe-based visual-inertial odometry using nonlinear
optimization", 2015; the chain is that of T. Qin et al., "VINS-Mono", 2018, without points among the unknowns).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.inertial import fixed_lag_kernels as kernels
from kiteline_agent.inertial import inertial_kernels
from kiteline_agent.inertial.inertial_config import FixedLagConfig, StartDeviations
from kiteline_agent.inertial.preintegration import Preintegrated, Samples, preintegrate
from kiteline_core.arrays import F64, Bool
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.order_statistics import median

MOST_STATES = 6  # in the window, while samples come frames late
_BY_DEFINITION = 1e-4  # m and rad: deviation of a pose that defines its map
_VELOCITY_CHI2 = 7.81  # 95 % with 3 degrees of freedom: an odometer's velocity beyond it is down-weighted


@dataclass(frozen=True, slots=True)
class VisualPoints:
    """Observations of landmarks in one frame.

    xyz: (n,3) m in m. ray: (n,3) m, one standard deviation of depth. observed: (n,3) u, v, disparity px (< 0: none).
    sigma_px: (n,). inlier: (n,) which of them are used.
    """

    xyz: F64
    ray: F64
    observed: F64
    sigma_px: F64
    inlier: Bool

    def depth_m(self, T_m_b: F64) -> float:
        """Median distance of the inliers from a body at T_m_b (4,4); 0 without any."""
        seen = self.xyz[self.inlier]
        return median(np.linalg.norm(seen - T_m_b[:3, 3], axis=1)) if len(seen) else 0.0


@dataclass(frozen=True, slots=True)
class BodyVelocity:
    """Velocity by an odometer.

    value: (3,) m/s of the body's origin in the body's axes. cov: (3,3) of it, huge in unmeasured directions. inflated:
    (3,3) the same, inflated for errors that are correlated over frames. age_s: time from measurement to frame.
    """

    value: F64
    cov: F64
    inflated: F64
    age_s: float = 0.0


@dataclass(frozen=True, slots=True)
class InertialState:
    """State of the body at a frame.

    T_m_b: (4,4). velocity: (3,) m/s in m. bias: (6,) gyro rad/s, accel m/s^2. tilt: (2,) rad, rotation of the vertical
    from z of m about x and y. cov: (17,17) of [rotation (right), position, velocity, gyro bias, accel bias, tilt].
    What it knows of gravity in the body: gravity_alignment.up_of.
    """

    T_m_b: F64
    velocity: F64
    bias: F64
    tilt: F64
    cov: F64

    @property
    def pose_cov(self) -> F64:
        """(6,6) covariance [translation in m, rotation about the body's axes]."""
        order = np.array([3, 4, 5, 0, 1, 2])
        return np.asarray(self.cov[np.ix_(order, order)])


@dataclass(frozen=True, slots=True)
class InertialMotion:
    """The body at an instant after the last frame.

    T_m_b: (4,4). velocity: (3,) m/s in m. rate: (3,) rad/s in b. growth: (6,6) covariance of the motion since that
    frame, [translation in m, rotation about the body's axes].
    """

    T_m_b: F64
    velocity: F64
    rate: F64
    growth: F64


class FixedLagSmoother:
    """Fixed-lag smoother with a dense prior. Call `start` first, then `add` once a frame."""

    def __init__(
        self, camera: RectifiedCamera, calibration: ImuCalibration, config: FixedLagConfig, gravity_m_s2: float = 9.81
    ) -> None:
        n, p = max(config.states, MOST_STATES) + 1, config.points
        self._config = config
        self._states = config.states  # in the window
        self._calibration = calibration
        self._gravity = gravity_m_s2
        floor = np.repeat([config.turn_floor_rad, config.velocity_floor_m_s, config.position_floor_m], 3)
        self._floor = np.diag(floor**2)  # of the covariance of an interval
        self._walk_square = np.array([calibration.gyro_walk, calibration.accel_walk]) ** 2
        self.extra_walk = np.zeros(2)  # of the biases of gyro and accelerometer, while what corrects samples changes
        T_c_b = se3.inverse(camera.T_b_c)
        self._r_cb, self._t_cb = np.ascontiguousarray(T_c_b[:3, :3]), T_c_b[:3, 3].copy()
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.bf])
        self._n = 0
        self._rot, self._state, self._tilt = np.zeros((n, 3, 3)), np.zeros((n, 12)), np.zeros(2)
        self._newest: tuple[Samples, Preintegrated] | None = None  # preintegrated last
        self._imu_dt, self._imu_turn, self._imu_vp = np.zeros(n), np.zeros((n, 3, 3)), np.zeros((n, 6))
        self._imu_jac, self._imu_bias = np.zeros((n, 9, 6)), np.zeros((n, 6))
        self._imu_info, self._imu_walk, self._imu_length = np.zeros((n, 9, 9)), np.zeros((n, 2)), np.zeros((n, 9))
        self._prior_h, self._prior_b = np.zeros((17, 17)), np.zeros(17)
        self._prior_r, self._prior_s, self._prior_tilt = np.eye(3), np.zeros(12), np.zeros(2)
        self._counts, self._scale = np.zeros(n, np.int64), np.ones(n)
        self._xyz, self._ray, self._observed = np.zeros((n, p, 3)), np.zeros((n, p, 3)), np.zeros((n, p, 3))
        self._sigma, self._use = np.ones((n, p)), np.zeros((n, p), np.bool_)
        self._vis_h, self._vis_b = np.zeros((n, 6, 6)), np.zeros((n, 6))
        self._vis_r, self._vis_p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        self._vel, self._vel_info = np.zeros((n, 3)), np.zeros((n, 3, 3))
        self._cov = np.zeros((17, 17))

    @property
    def running(self) -> bool:
        """True if there is a state."""
        return self._n > 0

    @property
    def gravity(self) -> F64:
        """Gravity (3,) in m, m/s^2."""
        down, jac = np.empty(3), np.empty((3, 2))
        inertial_kernels.down_of_tilt(self._tilt, down, jac)
        return self._gravity * down

    @property
    def state(self) -> InertialState:
        """The newest state."""
        k = self._n - 1
        s = self._state[k]
        return InertialState(
            se3.from_rt(self._rot[k], s[:3]), s[3:6].copy(), s[6:].copy(), self._tilt.copy(), self._cov.copy()
        )

    def start(
        self, T_m_b: F64, velocity: F64, bias: F64, gravity: F64, deviations: StartDeviations, cov: F64 | None = None
    ) -> None:
        """Start with one state. gravity: (3,) in m, of which only the direction is used. cov: (17,17), if known."""
        self._n = 1
        self._rot[0] = T_m_b[:3, :3]
        self._state[0] = np.concatenate([T_m_b[:3, 3], velocity, bias])
        self._tilt[:] = tilt_of(gravity)
        d = deviations
        sigma = np.repeat(
            [d.turn_rad, d.position_m, d.velocity_m_s, d.gyro_bias_rad_s, d.accel_bias_m_s2, d.tilt_rad],
            [3, 3, 3, 3, 3, 2],
        )
        self._cov = np.diag(sigma**2) if cov is None else cov.copy()
        self._prior_h[:] = np.diag(sigma**-2.0) if cov is None else np.linalg.inv(cov)
        self._prior_b[:] = 0.0
        self._prior_r[:], self._prior_s[:], self._prior_tilt[:] = self._rot[0], self._state[0], self._tilt
        self._counts[0] = 0
        self._vis_h[0], self._vis_b[0] = 0.0, 0.0
        self._vis_r[0], self._vis_p[0] = self._rot[0], self._state[0, :3]
        self._vel_info[0] = 0.0

    def stop(self) -> None:
        """Drop all states."""
        self._n = 0

    def predict(self, samples: Samples) -> F64:
        """Predict the pose (4,4) after the samples, which begin at the newest state."""
        state = self.state
        motion = self._integrated(samples, state.bias)
        return motion.propagate(state.T_m_b, state.velocity, state.bias, self.gravity)[0]

    def _integrated(self, samples: Samples, bias: F64) -> Preintegrated:
        """The samples preintegrated; cached, as a frame's prediction and its update need the same ones."""
        held = self._newest
        if held is None or held[0] is not samples or not (held[1].bias == bias).all():
            motion = preintegrate(samples, bias, self._calibration, self._config.imu_inflation)
            held = self._newest = samples, motion
        return held[1]

    def add(
        self, samples: Samples, points: VisualPoints | None, odometry: BodyVelocity | None = None,
        length_error: float = 0.0,
    ) -> InertialState | None:  # fmt: skip
        """Add a frame: samples since the last one, landmark observations (None: dead reckoning) and odometry.

        length_error: relative deviation of lengths in the map. A change of velocity in it differs by that from what the
        IMU measures. Without it, biases and vertical would take up the difference, and poses would lag behind the
        images later. Returns None, without a state, if the system could not be solved; `start` is needed then.
        """
        while self._n > self._states - 1:
            if not self._drop_oldest():
                self.stop()
                return None
        k = self._n
        bias = self._state[k - 1, 6:].copy()
        motion = self._integrated(samples, bias)
        T_m_b, velocity = motion.propagate(
            se3.from_rt(self._rot[k - 1], self._state[k - 1, :3]), self._state[k - 1, 3:6], bias, self.gravity
        )
        if not (np.isfinite(T_m_b).all() and np.isfinite(motion.cov).all()):
            self.stop()
            return None
        change = self._rot[k - 1].T @ (velocity - self._state[k - 1, 3:6])
        self._imu_length[k - 1, 3:6], self._imu_length[k - 1, 6:] = change, 0.5 * motion.dt_s * change
        self._imu_length[k - 1] *= self._config.length_inflation * length_error
        self._put_interval(k - 1, motion)
        self._rot[k] = se3.orthonormalise(T_m_b)[:3, :3]
        self._state[k] = np.concatenate([T_m_b[:3, 3], velocity, bias])
        self._put_points(k, points)
        self._put_velocity(k, odometry, motion)
        self._n = k + 1
        c = self._config
        cost = kernels.smooth(
            self._n, c.iterations, min(c.fresh, self._n), self._rot, self._state, self._tilt, self._gravity,
            self._imu_dt, self._imu_turn, self._imu_vp, self._imu_jac, self._imu_bias, self._imu_info, self._imu_walk,
            self._prior_h, self._prior_b, self._prior_r, self._prior_s, self._prior_tilt, self._r_cb, self._t_cb,
            self._intrinsics, self._counts, self._xyz, self._ray, self._observed, self._sigma, self._use, c.chi2,
            self._scale, self._vis_h, self._vis_b, self._vis_r, self._vis_p, self._vel,
            self._vel_info, self._cov,
        )  # fmt: skip
        if not (cost >= 0.0 and np.isfinite(self._state[: self._n]).all()):
            self.stop()
            return None
        return self.state

    def hold(self, intervals: int) -> None:
        """Keep so many intervals in the window, whose samples are awaited, if there is room."""
        self._states = max(self._config.states, min(intervals + 1, MOST_STATES))

    def replace(self, back: int, samples: Samples) -> None:
        """Replace the samples of an interval. back: 0 for that before the newest state. Older ones are final."""
        k = self._n - 2 - back
        if k >= 0:
            bias = self._imu_bias[k].copy()
            self._put_interval(k, preintegrate(samples, bias, self._calibration, self._config.imu_inflation))

    def shift_accel_bias(self, change: F64) -> None:
        """Shift all biases of the accelerometer by (3,) m/s^2, after the correction of its samples changed."""
        self._state[: self._n, 9:] += change
        self._imu_bias[: self._n, 3:] += change
        self._prior_s[9:] += change

    def begin_map(self, T_m_b: F64) -> None:
        """Begin a new map, in which the newest body pose is T_m_b (4,4) by definition.

        Velocity, biases and gravity are kept; the uncertainty of the old attitude is added to theirs.
        """
        old = self.state
        r, gravity = old.T_m_b[:3, :3], self.gravity
        down, jac = np.empty(3), np.empty((3, 2))
        inertial_kernels.down_of_tilt(self._tilt, down, jac)
        # the error of the old attitude becomes one of vectors in the map's axes
        carry = np.eye(17)[6:]
        carry[:3, :3] = se3.skew(old.velocity) @ r
        carry[9:, :3] = np.linalg.pinv(self._gravity * jac) @ se3.skew(gravity) @ r
        cov = np.zeros((17, 17))
        cov[:6, :6] = _BY_DEFINITION**2 * np.eye(6)
        cov[6:, 6:] = carry @ old.cov @ carry.T
        self.start(old.T_m_b, old.velocity, old.bias, gravity, StartDeviations(), 0.5 * (cov + cov.T))
        self.move_map(T_m_b @ se3.inverse(old.T_m_b))

    def move_map(self, T_new_old: F64) -> None:
        """Transform all states after the map moved: `p_new = T_new_old p_old`."""
        if self._n == 0:
            return
        r, t = T_new_old[:3, :3], T_new_old[:3, 3]
        n = self._n
        tilt_change = _tilt_jacobian(r, self._tilt)
        old_prior_tilt = self._prior_tilt - self._tilt
        self._tilt[:] = tilt_of(r @ self.gravity)
        self._prior_tilt[:] = self._tilt + tilt_change @ old_prior_tilt
        self._rot[:n] = r @ self._rot[:n]
        self._prior_r[:], self._vis_r[:n] = r @ self._prior_r, r @ self._vis_r[:n]
        for block in (self._state[:n], self._prior_s[None, :]):
            block[:, :3] = block[:, :3] @ r.T + t
            block[:, 3:6] = block[:, 3:6] @ r.T
        self._vis_p[:n] = self._vis_p[:n] @ r.T + t
        # positions, velocities and the tilt of the prior rotate with the map; the rest is in the body frame
        q = np.eye(17)
        q[3:6, 3:6], q[6:9, 6:9], q[15:, 15:] = r, r, tilt_change
        back = np.eye(17)
        back[3:6, 3:6], back[6:9, 6:9], back[15:, 15:] = r.T, r.T, np.linalg.inv(tilt_change)
        self._prior_h[:] = back.T @ self._prior_h @ back
        self._prior_b[:] = back.T @ self._prior_b
        self._cov = q @ self._cov @ q.T
        q6 = q[:6, :6]
        self._vis_h[:n] = q6 @ self._vis_h[:n] @ q6.T
        self._vis_b[:n] = self._vis_b[:n] @ q6.T
        self._xyz[:n] = self._xyz[:n] @ r.T + t
        self._ray[:n] = self._ray[:n] @ r.T

    def scale_map(self, factor: float, centre: F64) -> None:
        """Scale all states after lengths in the map were multiplied by `factor` about centre (3,).

        The camera's positions scale; its lever arm in the body does not.
        """
        n, p_b_c = self._n, -self._r_cb.T @ self._t_cb
        states = (self._state[:n], self._rot[:n]), (self._prior_s, self._prior_r), (self._vis_p[:n], self._vis_r[:n])
        for block, rotation in states:  # of position, velocity and biases; the last of position alone
            block[..., :3] = centre + factor * (block[..., :3] - centre) + (factor - 1.0) * (rotation @ p_b_c)
            block[..., 3:6] *= factor
        self._xyz[:n] = centre + factor * (self._xyz[:n] - centre)
        self._ray[:n] *= factor
        q = np.ones(17)
        q[3:9] = factor
        self._prior_h /= np.outer(q, q)
        self._prior_b /= q
        self._cov *= np.outer(q, q)
        self._vis_h[:n] /= np.outer(q[:6], q[:6])
        self._vis_b[:n] /= q[:6]

    def _put_interval(self, k: int, motion: Preintegrated) -> None:
        self._imu_dt[k], self._imu_turn[k], self._imu_vp[k] = motion.dt_s, motion.turn, motion.vp
        self._imu_jac[k], self._imu_bias[k] = motion.jac, motion.bias
        by_length = self._imu_length[k]
        self._imu_info[k] = np.linalg.inv(motion.cov + self._floor + np.outer(by_length, by_length))
        self._imu_walk[k] = 1.0 / ((self._walk_square + self.extra_walk**2) * motion.dt_s)

    def _put_points(self, k: int, points: VisualPoints | None) -> None:
        self._vis_h[k], self._vis_b[k] = 0.0, 0.0
        self._vis_r[k], self._vis_p[k] = self._rot[k], self._state[k, :3]
        self._scale[k] = 1.0 / self._config.visual_inflation
        self._counts[k] = 0
        if points is None:
            return
        n = min(len(points.xyz), self._config.points)
        self._counts[k] = n
        self._xyz[k, :n], self._ray[k, :n] = points.xyz[:n], points.ray[:n]
        self._observed[k, :n], self._sigma[k, :n] = points.observed[:n], points.sigma_px[:n]
        self._use[k, :n] = points.inlier[:n]

    def _put_velocity(self, k: int, odometry: BodyVelocity | None, motion: Preintegrated) -> None:
        """Store an odometer's velocity, propagated to the frame by the IMU, unless it fails the gate."""
        self._vel_info[k] = 0.0
        if odometry is None:
            return
        c, r, velocity = self._config, self._rot[k], self._state[k, 3:6]
        change = (velocity - self._state[k - 1, 3:6]) * (odometry.age_s / motion.dt_s)
        rotation = se3.so3_exp(se3.so3_log(motion.turn) * (odometry.age_s / motion.dt_s))
        value = rotation.T @ odometry.value + r.T @ change
        cov = rotation.T @ odometry.cov @ rotation
        off = value - r.T @ velocity
        square = float(off @ np.linalg.solve(cov + r.T @ self._cov[6:9, 6:9] @ r, off))
        if not square < c.velocity_gate:
            return
        self._vel[k] = value
        weight = min(1.0, float(np.sqrt(_VELOCITY_CHI2 / max(square, 1e-9))))
        self._vel_info[k] = weight * np.linalg.inv(rotation.T @ odometry.inflated @ rotation)

    def _drop_oldest(self) -> bool:
        """Marginalise the oldest state into the prior and shift the others."""
        walk = self._config.tilt_walk_rad**2 * float(self._imu_dt[0])
        ok = kernels.marginalise(
            self._rot[:2], self._state[:2], self._tilt, self._gravity, self._imu_dt[0], self._imu_turn[0],
            self._imu_vp[0], self._imu_jac[0], self._imu_bias[0], self._imu_info[0], self._imu_walk[0],
            self._vis_h[0], self._vis_b[0], self._vis_r[0], self._vis_p[0], self._vel[0], self._vel_info[0], walk,
            self._prior_h, self._prior_b, self._prior_r, self._prior_s, self._prior_tilt,
        )  # fmt: skip
        n = self._n
        arrays: list[NDArray[np.generic]] = [
            self._rot, self._state, self._imu_dt, self._imu_turn, self._imu_vp, self._imu_jac, self._imu_bias,
            self._imu_info, self._imu_walk, self._imu_length, self._counts, self._scale, self._vis_h, self._vis_b,
            self._vis_r, self._vis_p, self._vel, self._vel_info,
        ]  # fmt: skip
        if self._config.fresh > 1:  # else points of older frames are condensed already
            arrays += [self._xyz, self._ray, self._observed, self._sigma, self._use]
        for array in arrays:
            array[: n - 1] = array[1:n].copy()
        self._n = n - 1
        return bool(ok)


def tilt_of(gravity: F64) -> F64:
    """Rotation (2,) in rad about x and y from z to `-gravity`."""
    up = -gravity / np.linalg.norm(gravity)
    s, angle = float(np.hypot(up[0], up[1])), float(np.arctan2(np.hypot(up[0], up[1]), up[2]))
    k = angle / s if s > 1e-12 else 1.0
    return np.array([-k * up[1], k * up[0]])


def tilt_by_direction(gravity: F64, across: F64) -> F64:
    """Change (2,2) of the tilt, in rad, by turns of `gravity` (3,) towards the unit vectors across (3,2)."""
    down, jac = np.empty(3), np.empty((3, 2))
    inertial_kernels.down_of_tilt(tilt_of(gravity), down, jac)
    return np.asarray(np.linalg.lstsq(jac, across, rcond=None)[0])


def _tilt_jacobian(r: F64, tilt: F64) -> F64:
    """Jacobian (2,2) of the tilt of a rotated map by the tilt before."""
    down, jac, down_new, jac_new = np.empty(3), np.empty((3, 2)), np.empty(3), np.empty((3, 2))
    inertial_kernels.down_of_tilt(tilt, down, jac)
    inertial_kernels.down_of_tilt(tilt_of(r @ down), down_new, jac_new)
    return np.asarray(np.linalg.lstsq(jac_new, r @ jac, rcond=None)[0])

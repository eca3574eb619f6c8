"""Motion over a loss of images, by the IMU and by the velocity that images show after it.

Dead reckoning for seconds errs in velocity and position alike: the accelerometer's error, integrated once and twice.
A quarter of a second of images in a new submap tells the velocity there, and by the covariance of the two most of the
error of the position, as in a Kalman smoother.
"""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial.inertial_tracker import InertialTracker
from kiteline_agent.inertial.preintegration import preintegrate
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration

_LEAST_VARIANCE = 1e-12  # a record holds no deviation of 0
_AFTER_S = 0.19  # s in the new submap after which the velocity is known: four frames at 20 Hz
_MOST_S = 1.0  # s; later the velocity tells as little of the loss as the IMU of the time since
_ACCEL_M_S2 = 0.3  # m/s^2; error of a worn accelerometer under vibration, meanwhile
_IMAGE_M = 0.004  # m; error of the motion by images, meanwhile


@dataclass(frozen=True, slots=True)
class LossMotion:
    """What dead reckoning over a loss is to be corrected by. shift: (3,) m to be added to the body's position, in o.

    sigma_m, sigma_rad: largest standard deviations of position and rotation, along or about any axis.
    """

    shift: F64
    sigma_m: float
    sigma_rad: float


@dataclass(frozen=True, slots=True)
class _Begin:
    """The body where a new submap begins, by dead reckoning, in its axes, which are those of o. cov: (6,6) of position
    and velocity.
    """

    t_ns: int
    T_m_b: F64
    velocity: F64
    bias: F64
    gravity: F64
    cov: F64
    sigma_rad: float


class LossMotionEstimator:
    """Call `begin` where a submap begins after a loss, then `update` with each frame tracked in it."""

    def __init__(self, tracker: InertialTracker, calibration: ImuCalibration, gravity_m_s2: float) -> None:
        self._tracker = tracker
        self._calibration = calibration
        self._gravity_m_s2 = gravity_m_s2
        self._begin: _Begin | None = None

    def clear(self) -> None:
        """Forget the loss: images were lost again, or it was measured."""
        self._begin = None

    def begin(self, t_ns: int, T_m_b: F64, R_o_m: F64) -> LossMotion | None:
        """A submap begins at T_m_b (4,4) in its own frame, before the tracker moves there.

        R_o_m: (3,3) of the old submap. None if the IMU did not carry the vehicle over the loss.
        """
        self._begin = None
        state, R_l_m = self._tracker.state, self._tracker.gravity_rotation()
        if state is None or R_l_m is None:
            return None
        turn = np.kron(np.eye(2), R_o_m)
        cov = turn @ state.cov[3:9, 3:9] @ turn.T
        self._begin = _Begin(
            t_ns, T_m_b.copy(), R_o_m @ state.velocity, state.bias, -self._gravity_m_s2 * (R_o_m @ R_l_m[2]), cov,
            _largest(state.cov[:3, :3]),
        )  # fmt: skip
        return LossMotion(np.zeros(3), _largest(cov[:3, :3]), self._begin.sigma_rad)

    def update(self, t_ns: int, T_m_b: F64) -> LossMotion | None:
        """A frame was tracked at T_m_b (4,4) in the new submap. Returns the better motion, once, when it is known."""
        begin = self._begin
        passed_s = 0.0 if begin is None else (t_ns - begin.t_ns) * 1e-9
        if begin is None or passed_s < _AFTER_S:
            return None
        self._begin = None
        samples = self._tracker.samples_between(begin.t_ns, t_ns)
        if samples is None or passed_s > _MOST_S:
            return None
        motion = preintegrate(samples, begin.bias, self._calibration)
        predicted, _ = motion.propagate(begin.T_m_b, begin.velocity, begin.bias, begin.gravity)
        wrong = (T_m_b[:3, 3] - predicted[:3, 3]) / passed_s
        noise = (0.5 * _ACCEL_M_S2 * passed_s) ** 2 + (_IMAGE_M / passed_s) ** 2
        gain = begin.cov[:3, 3:] @ np.linalg.inv(begin.cov[3:, 3:] + noise * np.eye(3))
        left = begin.cov[:3, :3] - gain @ begin.cov[3:, :3]
        return LossMotion(gain @ wrong, _largest(left), begin.sigma_rad)


def _largest(cov: F64) -> float:
    return float(np.sqrt(max(float(np.linalg.eigvalsh(0.5 * (cov + cov.T))[-1]), _LEAST_VARIANCE)))

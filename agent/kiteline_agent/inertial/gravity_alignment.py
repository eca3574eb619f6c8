"""Gravity alignment of the odometry frame and the first submap.

The accelerometer gives a first guess, which is accurate at rest only. A few frames later the poses by images give the
acceleration, so that gravity is known to half a degree in motion too, to three degrees with a worn or shaken IMU. The
first submap keeps its axes; its rotation is sent to the base, and a flight controller gets its first pose once the
rotation is known: never in a frame whose vertical nothing has measured. That frame then follows what the smoother
finds, too slowly to be seen as motion.
"""

import numpy as np

from kiteline_agent.inertial import inertial_kernels
from kiteline_agent.inertial.fixed_lag import InertialState
from kiteline_agent.inertial.inertial_tracker import InertialTracker
from kiteline_codec.coding import quantise
from kiteline_codec.schema import GravityAlignment
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import SubmapId

_MIN_TILT_RAD = 0.035  # rad; tilt above which the map is gravity-aligned: two degrees
_PATIENCE_S = 2.0  # s; longest time that a flight controller waits for more than the accelerometer's first guess
_SETTLED_S = 1.0  # s of fusion after which the vertical is known to a degree or two: after the first frames to five
_SURE_RAD = 0.0175  # rad; deviation of a vertical that is better than that of the first frames: a degree
_FOLLOW_S = 3.0  # s; time constant with which the vertical of a flight controller follows the smoother's
_EVERY_S = 0.19  # s between two small turns of it
_FOLLOW_RAD_S = 0.005  # rad/s, at most: 3 degrees in 10 s. At 10 m/s it bends the path by 0.05 m/s^2
_LEAST_M_S2 = 0.1  # of a specific force that points anywhere
_ATTITUDE_TILT = np.array([0, 1, 2, 15, 16])  # in the covariance of a state
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # R_m_c of a level camera that looks along x


def level_rotation(accel: F64) -> F64:
    """R_m_b (3,3) with z up and yaw zero, from the mean specific force (3,) in the body, which points up at rest.

    1 if there is next to none: a sensor that gives zeros tells no vertical.
    """
    force_m_s2 = float(np.linalg.norm(accel))
    if not force_m_s2 > _LEAST_M_S2:
        return np.eye(3)
    up = accel / force_m_s2
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(up, z)
    s, c = float(np.linalg.norm(axis)), float(up @ z)
    if s < 1e-9:
        return np.eye(3) if c > 0 else np.diag([1.0, -1.0, -1.0])
    return se3.so3_exp(axis / s * np.arctan2(s, c))


def up_of(state: InertialState) -> tuple[F64, float]:
    """Unit vector (3,) against gravity in the body, and its deviation about an axis across it, rad."""
    down, jac = np.empty(3), np.empty((3, 2))
    inertial_kernels.down_of_tilt(state.tilt, down, jac)
    R_b_m = state.T_m_b[:3, :3].T
    up = R_b_m @ -down
    by_state = np.concatenate([se3.skew(up), R_b_m @ -jac], axis=1)  # of the attitude, of the vertical
    cov = by_state @ state.cov[np.ix_(_ATTITUDE_TILT, _ATTITUDE_TILT)] @ by_state.T
    return up, float(np.sqrt(max(0.5 * float(np.trace(cov)), 0.0)))


class GravityAligner:
    """Estimates the tilt of the odometry frame and of the first submap. Call `update` once a frame."""

    def __init__(self, camera: RectifiedCamera, inertial: InertialTracker | None) -> None:
        self._camera = camera
        self._inertial = inertial
        self._began_ns: int | None = None
        self._R_l_o: F64 | None = None if inertial is not None else np.eye(3)
        self._renewed = self._known = False
        self._p_l_o: F64 | None = None
        self._guessed = False  # the first submap is upright only if the camera was level
        self._fused_ns: int | None = None  # stamp of the first frame since which images and IMU are fused
        self._followed_ns = 0  # stamp of the frame up to which the smoother's vertical is followed
        self._rough = False  # it was told from a few frames, as samples had just come
        self._doubted = False  # since it was known nothing has measured a part of the turns
        self.tilt_rad = 0.0  # of the first submap, or of the one that continues it

    @property
    def R_l_o(self) -> F64 | None:
        """(3,3) that gravity-aligns the odometry frame; None before.

        It follows the smoother's vertical slowly, and turns at once after `renew`, `doubt` and a guess.
        """
        return None if self._renewed and not self._known else self._R_l_o

    @property
    def p_l_o(self) -> F64 | None:
        """(3,) m, the odometry frame's origin in the gravity-aligned frame; None where that never turned."""
        return self._p_l_o

    def forget(self) -> None:
        """The vertical came from an IMU that contradicts the images: it is not known in this flight."""
        self._inertial, self._R_l_o = None, None

    def renew(self) -> None:
        """The IMU is mounted otherwise than the calibration says, and so was the vertical: it is measured again."""
        if self._inertial is not None:
            self._renewed, self._known = True, False

    def doubt(self) -> None:
        """Neither images nor IMU have measured how the vehicle turned: the odometry frame may lean from here on."""
        self._doubted = self._known

    def settle(self, t_ns: int) -> None:
        """The fusion begins at this frame with a vertical that a window of many frames has told."""
        self._fused_ns = t_ns - round(_SETTLED_S * 1e9)

    def ignore_imu(self) -> None:
        """Go on as without an IMU, for a camera that was level when the flight began."""
        self._inertial, self._R_l_o = None, np.eye(3)

    def first_pose(self, imu: ImuBatch | None) -> F64:
        """T_m_c of the first keyframe: body at the origin, z up by the accelerometer, else for a level camera."""
        if self._inertial is not None and imu is not None and len(imu.t_ns):
            R_m_b = level_rotation(imu.accel.mean(axis=0))
        else:
            self._guessed = True
            R_m_b = AHEAD @ self._camera.T_b_c[:3, :3].T
        return se3.from_rt(R_m_b, np.zeros(3)) @ self._camera.T_b_c

    def update(
        self, t_ns: int, T_m_b: F64, T_o_m: F64, submap: SubmapId, *, continued: bool
    ) -> GravityAlignment | None:
        """Process a frame tracked at T_m_b (4,4), with T_o_m (4,4) from the submap to the odometry frame.

        continued: the submap is the first one, or continues it. Returns how it is tilted, once, if it is.
        """
        if self._inertial is None:
            return None
        self._began_ns = t_ns if self._began_ns is None else self._began_ns
        if self._known and not self._is_settled(t_ns):
            self._follow(t_ns, T_o_m, (T_o_m @ T_m_b)[:3, 3])
            return None
        R_l_m = self._inertial.gravity_rotation()
        if R_l_m is None:
            waited = not self._known and t_ns - self._began_ns > _PATIENCE_S * 1e9
            if waited and not (self._renewed or self._guessed):  # a guess may be tilted by any angle
                self._R_l_o = np.eye(3)
            return None
        if self._R_l_o is None:
            self._R_l_o = level_rotation(T_o_m[:3, :3] @ R_l_m[2])
        else:
            self._turn_upright(R_l_m, T_o_m[:3, :3], (T_o_m @ T_m_b)[:3, 3])
        if self._known:
            return None
        self._known, self._rough = True, self._guessed
        self.tilt_rad = float(np.linalg.norm(se3.so3_log(R_l_m)))
        if not continued or self._renewed or self.tilt_rad < _MIN_TILT_RAD:
            return None
        return upright_about(submap, R_l_m, T_m_b[:3, 3])

    def _is_settled(self, t_ns: int) -> bool:
        """True if the vertical is known better than when it was told, or than what was guessed since."""
        assert self._inertial is not None
        if not self._inertial.running:
            self._fused_ns = None
            return False
        self._fused_ns = t_ns if self._fused_ns is None else self._fused_ns
        if not (self._doubted or self._rough):
            return False
        state = self._inertial.state
        sure = state is not None and up_of(state)[1] < _SURE_RAD
        return sure or (self._doubted and t_ns - self._fused_ns >= _SETTLED_S * 1e9)

    def _follow(self, t_ns: int, T_o_m: F64, here_o: F64) -> None:
        """Turn the gravity-aligned frame slowly to the smoother's vertical, once images and IMU are fused for long."""
        settled = self._fused_ns is not None and t_ns - self._fused_ns >= _SETTLED_S * 1e9
        dt_s = (t_ns - self._followed_ns) * 1e-9
        if dt_s < _EVERY_S:  # each costs as much as a hundred landmarks
            return
        self._followed_ns = t_ns
        if not settled or self._doubted or self._rough or dt_s > _FOLLOW_S:
            return
        assert self._inertial is not None
        R_l_m, state = self._inertial.gravity_rotation(), self._inertial.state
        if R_l_m is None or state is None or up_of(state)[1] > _SURE_RAD:
            return
        turn = self._upright_turn(R_l_m, T_o_m[:3, :3])
        angle = float(np.linalg.norm(turn))
        self._turn(min(dt_s / _FOLLOW_S, _FOLLOW_RAD_S * dt_s / max(angle, 1e-9)) * turn, here_o)

    def _turn_upright(self, R_l_m: F64, R_o_m: F64, here_o: F64) -> None:
        """Turn the gravity-aligned frame at once."""
        self._doubted = self._rough = False
        self._turn(self._upright_turn(R_l_m, R_o_m), here_o)

    def _upright_turn(self, R_l_m: F64, R_o_m: F64) -> F64:
        """Rotation vector (3,) that makes the gravity-aligned frame upright, without a change of its heading."""
        assert self._R_l_o is not None
        return np.asarray(se3.so3_log(level_rotation(self._R_l_o @ R_o_m @ R_l_m[2])))

    def _turn(self, turn: F64, here_o: F64) -> None:
        """Turn the gravity-aligned frame about the vehicle, at here_o (3,) m. turn: (3,) rad."""
        assert self._R_l_o is not None
        here_l = self._R_l_o @ here_o + (0.0 if self._p_l_o is None else self._p_l_o)
        self._R_l_o = se3.so3_exp(turn) @ self._R_l_o
        self._p_l_o = here_l - self._R_l_o @ here_o


def upright_about(submap: SubmapId, R_l_m: F64, here: F64) -> GravityAlignment:
    """The record of a tilted submap. here: (3,) of the vehicle, which stays where it is in the world.

    Rounded as on the wire: the base places the submap exactly there, and its placement moves nothing.
    """
    T_l_m = se3.from_rt(R_l_m, here - R_l_m @ here)
    return GravityAlignment(submap, quantise.pose(quantise.pose_codes(T_l_m)))

"""Pose of the camera in the submap and in the odometry frame, and its constant-velocity motion."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_KNOWN_S = 1.0  # s without an image, whose mean motion still tells how the vehicle moves
_KNOWN_TRACE = 1.2  # of the rotation in that time, at least: 84 degrees
_LASTS_S = 0.5  # s of a guess, after which the motion that it goes on with fades
_TURN_S, _WAY_S = 0.5, 2.0  # s; time constants of that: three flights of EuRoC turn on for less long than they fly on
_EVEN_SPACING = 0.2  # relative; frame intervals that differ by less count as equal


class PoseState:
    """Camera pose and velocity. Whatever moves the map leaves the odometry frame still.

    T_m_c: (4,4) camera in the active submap. T_o_m: (4,4) submap in the odometry frame. velocity: (3,) m/s in m.
    moves: True if the velocity was measured. Between frames that are measured, poses may be guessed.
    """

    def __init__(self) -> None:
        self.T_m_c: F64 = np.eye(4)
        self.T_o_m: F64 = np.eye(4)
        self.velocity: F64 = np.zeros(3)
        self.moves = False
        self._step_T: F64 = np.eye(4)  # T_c0_c1 of the last frame
        self._step_s: float | None = None  # duration of that motion; None: not known
        self._last_measured: tuple[F64, float] | None = None  # T_m_c (4,4) by the last new image, s since; None: now
        self._by_sensor = False  # since the last pose by images a sensor has told a part of the motion
        self._guessed = False  # a part of it was told by nothing
        self._guess_s = 0.0  # s since a sensor or a new image told the pose

    @property
    def is_guess(self) -> bool:
        """True if a part of the motion since the last pose by a new image in this submap was told by nothing."""
        return self._guessed

    @property
    def measured_over_s(self) -> float | None:
        """Time between the two poses that told the velocity; None if it is not known."""
        return (self._step_s or 0.0) if self.moves else None

    @property
    def T_c_m(self) -> F64:
        """(4,4) submap in the camera."""
        return se3.inverse(self.T_m_c)

    def predict(self, dt_s: float) -> F64:
        """T_m_c (4,4) after dt_s at constant velocity."""
        step = self._step_T
        if self._step_s is not None and abs(dt_s / self._step_s - 1.0) > _EVEN_SPACING:  # frames were skipped
            step = se3.exp(dt_s / self._step_s * se3.log(step))
        return se3.orthonormalise(self.T_m_c @ step)

    def predict_turned(self, dt_s: float, R_c0_c1: F64) -> F64:
        """T_m_c (4,4) after dt_s at constant velocity and a rotation that is known."""
        R_m_c = self.T_m_c[:3, :3] @ R_c0_c1
        return se3.orthonormalise(se3.from_rt(R_m_c, self.T_m_c[:3, 3] + dt_s * self.velocity))

    def twist(self, dt_s: float) -> F64:
        """Twist (6,) [m/s, rad/s] of the camera in its own axes, by which it moves in dt_s at constant velocity."""
        return np.asarray(se3.log(se3.inverse(self.T_m_c) @ self.predict(dt_s)) / dt_s)

    def guess(self, T_m_c: F64, dt_s: float) -> None:
        """Set a pose (4,4) that nothing measured. dt_s: since the last one.

        No vehicle turns on for seconds: one whose last motion goes on for 4 s is upside down.
        """
        measured_T_m_c, since_s = self._last_measured or (self.T_m_c, 0.0)
        self.T_m_c, self._guessed, self._guess_s = T_m_c, True, self._guess_s + dt_s
        if self._guess_s > _LASTS_S:
            way, turn = np.exp(-dt_s / _WAY_S), np.exp(-dt_s / _TURN_S)
            self._step_T = se3.exp(np.repeat([way, turn], 3) * se3.log(self._step_T))
            self.velocity = way * self.velocity
        if not self._by_sensor:
            self._last_measured = measured_T_m_c, since_s + dt_s

    def reckon(self, T_m_c: F64, dt_s: float) -> None:
        """Set a pose (4,4) by a sensor other than the camera. dt_s: since the last one."""
        before, follows_guess = self.T_m_c, self._last_measured is not None
        self.T_m_c, self._last_measured, self._by_sensor, self._guess_s = T_m_c, None, True, 0.0
        if not follows_guess:
            self._set_step(before, dt_s)

    def measured(self, T_m_c: F64, dt_s: float, *, repeated: bool = False) -> None:
        """Set a pose (4,4) by images. dt_s: since the last one. repeated: from an old image, no motion is derived.

        The motion is that since the last pose by a new image.
        """
        before, since_s = self._last_measured or (self.T_m_c, 0.0)
        since_s += dt_s
        long = self._by_sensor or since_s > _KNOWN_S or np.vdot(before[:3, :3], T_m_c[:3, :3]) < _KNOWN_TRACE
        guessed, self._guessed, self._by_sensor, self.T_m_c = self._guessed, repeated, False, T_m_c
        self._last_measured, self._guess_s = (T_m_c, since_s) if repeated else None, 0.0
        if guessed and long:
            self.reset_motion()
        elif not repeated:
            self._set_step(before, since_s)

    def _set_step(self, before: F64, dt_s: float) -> None:
        """Take the motion from a pose (4,4) to the present one, in dt_s, for that of the next frames."""
        self._step_T = se3.orthonormalise(se3.inverse(before) @ self.T_m_c)
        self._step_s = dt_s if dt_s > 0.0 else None
        if dt_s > 0.0:
            self.velocity = (self.T_m_c[:3, 3] - before[:3, 3]) / dt_s
            self.moves = True

    def reset_motion(self) -> None:
        """Forget the motion: the next prediction is the present pose."""
        self._step_T, self.velocity, self.moves = np.eye(4), np.zeros(3), False
        self._forget_guesses()

    def _forget_guesses(self) -> None:
        """The present pose is where it is by definition, whatever told the motion until here."""
        self._last_measured, self._by_sensor, self._guessed, self._guess_s = None, False, False, 0.0

    def set_motion(self, step_T: F64, velocity: F64) -> None:
        """Set the motion. step_T: (4,4) T_c0_c1 a frame. velocity: (3,) m/s in m."""
        self._step_T, self.velocity, self.moves = step_T, velocity, True

    def move_map(self, T_m_c: F64) -> None:
        """The map moved under the camera: set its pose in m to T_m_c (4,4), keep that in o."""
        T_o_c = self.T_o_m @ self.T_m_c
        change = T_m_c[:3, :3] @ self.T_m_c[:3, :3].T
        if self._last_measured is not None:
            measured_T_m_c, since_s = self._last_measured
            self._last_measured = se3.orthonormalise(T_m_c @ self.T_c_m @ measured_T_m_c), since_s
        self.velocity = change @ self.velocity
        self.T_m_c = se3.orthonormalise(T_m_c)
        self.T_o_m = se3.orthonormalise(T_o_c @ se3.inverse(self.T_m_c))

    def enter_submap(self) -> None:
        """Begin a new submap here; its axes are those of the odometry frame."""
        self.T_m_c = self.T_o_m @ self.T_m_c
        self.T_o_m = np.eye(4)
        self._forget_guesses()

    def rescale_map(self, metres: float) -> None:
        """Begin a submap in metres here whose axes are those of the old one. metres: one unit of it.

        All that was flown in it is longer by that, so the camera is where the old map has it.
        """
        T_o_c = self.T_o_m @ self.T_m_c
        self.T_m_c, self._step_T = scaled(self.T_m_c, metres), scaled(self._step_T, metres)
        self.velocity = metres * self.velocity
        self.T_o_m = se3.orthonormalise(T_o_c @ se3.inverse(self.T_m_c))
        self._forget_guesses()

    def rescale(self, metres: float) -> F64:
        """Begin a submap in metres here. metres: one unit of the old submap. Returns T_new_old (4,4), lengths in m."""
        T_m_c = scaled(self.T_m_c, metres)
        self.enter_submap()
        T_n_m = se3.orthonormalise(self.T_m_c @ se3.inverse(T_m_c))
        self._step_T, self.velocity = scaled(self._step_T, metres), metres * T_n_m[:3, :3] @ self.velocity
        return T_n_m


def scaled(T: F64, factor: float) -> F64:
    """T (4,4) with its translation multiplied by `factor`."""
    return se3.from_rt(T[:3, :3], T[:3, 3] * factor)

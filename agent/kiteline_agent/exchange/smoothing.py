"""Smooths corrections of the live pose: the odometry frame moves in the world at a limited speed."""

import numpy as np

from kiteline_agent.config import SmoothingConfig
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3


class Smoothing:
    """The reported pose of the odometry frame in the world, which follows the corrected one."""

    def __init__(self, config: SmoothingConfig) -> None:
        self._config = config
        self._T_w_o: F64 | None = None  # as reported
        self._goal: F64 | None = None  # as corrected, at the last call
        self._t_ns = 0
        self._hasty = False  # part of what is left is no correction of the base

    @property
    def on(self) -> bool:
        """True if corrections are smoothed."""
        return self._config.max_m_s > 0.0 or self._config.max_rad_s > 0.0

    @property
    def held(self) -> F64 | None:
        """T_w_o (4,4) as last reported; None before the first correction."""
        return self._T_w_o

    def snap(self) -> None:
        """Report the next corrected pose at once."""
        self._goal = None

    def clear(self) -> None:
        """Forget the world: no pose was reported in the one that follows."""
        self._T_w_o = self._goal = None
        self._hasty = False

    def begin(self, T_w_o: F64) -> None:
        """Corrections move the pose from here (4,4), if none was reported yet."""
        if self._T_w_o is None:
            self._T_w_o = self._goal = T_w_o

    def change_world(self, S_n_w: F64) -> None:
        """Poses are in frame n from now on, where w lies at S_n_w (4,4)."""
        if self._T_w_o is not None:
            self._T_w_o = sim3.normalise(S_n_w @ self._T_w_o)
        if self._goal is not None:
            self._goal = sim3.normalise(S_n_w @ self._goal)

    def hasten(self) -> None:
        """Follow faster until all that is left has been applied: the agent itself found what moved its map."""
        self._hasty = True

    def hold(self, t_ns: int) -> None:
        """The held pose is reported once more: nothing moved until this time."""
        self._t_ns = t_ns

    def move_odometry(self, T_o_n: F64) -> None:
        """The odometry frame o lies at n in the map: the pose of the map in the world stays as reported. (4,4)."""
        if self._T_w_o is not None:
            self._T_w_o = self._T_w_o @ T_o_n
        if self._goal is not None:
            self._goal = self._goal @ T_o_n

    def follow(self, T_w_o: F64, here_o: F64, t_ns: int, *, by_share: bool = False) -> F64:
        """The pose (4,4) to report for the corrected T_w_o (4,4). here_o: (3,) m, vehicle in o.

        The frame rotates about the vehicle, and its speed is measured there. A scale, if w has another unit of length
        than o, is applied at once. by_share: the same share of what is left in every second, without a least speed.
        """
        dt_s, self._t_ns = (t_ns - self._t_ns) * 1e-9, t_ns
        limits, before = self._config, self._goal
        self._goal = T_w_o
        if self._T_w_o is None or before is None or not self.on or dt_s <= 0.0:
            self._T_w_o = T_w_o
            return T_w_o
        if np.array_equal(self._T_w_o, T_w_o):
            self._hasty = False
            return T_w_o
        if float(np.linalg.norm(_shift(before, T_w_o, here_o))) > limits.snap_m:
            self._T_w_o = T_w_o
            return T_w_o
        held = self._T_w_o
        left = _shift(held, T_w_o, here_o)
        R_held = sim3.rigid(held)[:3, :3]
        rotation = se3.so3_log(sim3.rigid(T_w_o)[:3, :3] @ R_held.T)
        distance, angle = float(np.linalg.norm(left)), float(np.linalg.norm(rotation))
        shift_share = turn_share = 1.0  # of what is left of the correction, applied in this time
        if limits.max_m_s > 0.0 and distance > 0.0:
            least = 0.0 if by_share else limits.max_m_s / distance
            if self._hasty:
                least = max(least, limits.onboard_m / (dt_s * distance))
            shift_share = min(1.0, max(least, 1.0 / limits.time_s) * dt_s)
        if limits.max_rad_s > 0.0 and angle > 0.0:
            turn_share = min(1.0, limits.max_rad_s * dt_s / angle)
        if shift_share >= 1.0 and turn_share >= 1.0:
            self._T_w_o, self._hasty = T_w_o, False
            return T_w_o
        R = se3.so3_exp(turn_share * rotation) @ R_held
        at = se3.transform(held, here_o[None])[0] + shift_share * left
        scale = sim3.scale_of(T_w_o)
        self._T_w_o = sim3.normalise(sim3.of(scale, se3.from_rt(R, at - scale * R @ here_o)))
        return self._T_w_o


def _shift(T_w_a: F64, T_w_b: F64, here: F64) -> F64:
    """How far (3,) the vehicle at `here` (3,) moves in w from one pose of its frame to another."""
    return np.asarray((se3.transform(T_w_b, here[None]) - se3.transform(T_w_a, here[None]))[0])

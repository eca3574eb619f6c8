"""Where the frame of the poses that a flight controller gets lies: at the start, north, or where it was. Pure.

Poses are estimated in o, whose heading depends on how the body is mounted, and which begins anew with every agent. They
are sent in s: o turned about the vertical and moved, once, before the first pose. In a new flight the vehicle begins
with heading 0, or with the heading that the controller has. An agent that was restarted in flight goes on where the
controller believes itself to be, else where the last pose was sent: a controller that takes its yaw from the poses
would swing to any other heading.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_hw.mavlink.messages import Attitude, Heartbeat, LocalPosition, MessageInterval
from kiteline_hw.ports import PoseSample

_ATTITUDE, _POSITION = 30, 32  # message ids


@dataclass(frozen=True, slots=True)
class LastPose:
    """The last pose sent. position_m: (x, y, z) in local FRD. heading_rad: clockwise. armed: the vehicle was."""

    position_m: tuple[float, float, float]
    heading_rad: float
    armed: bool = False


@dataclass(frozen=True, slots=True)
class StartConfig:
    """How the frame is chosen."""

    north: bool = False  # heading as the controller has it
    greeting_ns: int = 1_500_000_000  # ns to wait for a heartbeat: an armed controller is in flight
    patience_ns: int = 5_000_000_000  # ns to wait for the controller's attitude where the last pose would do too
    said_ns: int = 3_000_000_000  # ns after which it is said that poses are held back
    fresh_ns: int = 500_000_000  # ns; an older attitude or position does not count
    interval_us: int = 50_000  # us between two messages while one is waited for
    idle_interval_us: int = 100_000  # us between two attitudes afterwards
    request_ns: int = 1_000_000_000  # ns between two requests


class StartFrame:
    """Chooses T_s_o (4,4), once. T_b_f: (4,4) flight controller in the body. last: of an agent before this one."""

    def __init__(self, T_b_f: F64, config: StartConfig | None = None, last: LastPose | None = None) -> None:
        self.config = config or StartConfig()
        self._T_b_f = T_b_f
        self._last = last
        self._T_s_o: F64 | None = None
        self._autopilot: Heartbeat | None = None
        self._attitude: tuple[Attitude, int] | None = None
        self._position: tuple[LocalPosition, int] | None = None
        self._first_ns: int | None = None
        self._requested_ns: int | None = None
        self._slowed = False

    @property
    def known(self) -> bool:
        """True once the frame is chosen."""
        return self._T_s_o is not None

    def holds(self, now_ns: int) -> bool:
        """True if poses have been held back for seconds because the heading is not known."""
        return self._T_s_o is None and self._first_ns is not None and now_ns - self._first_ns > self.config.said_ns

    def requests(self, m: Heartbeat, now_ns: int) -> Sequence[MessageInterval]:
        """The requests for messages about the controller's own pose, after its heartbeat `m`."""
        c = self.config
        self._autopilot = m
        if self.known:
            if self._slowed or self._requested_ns is None:
                return ()
            self._slowed = True
            return [
                MessageInterval(m.system, m.component, _ATTITUDE, c.idle_interval_us),
                MessageInterval(m.system, m.component, _POSITION, -1),
            ]
        if not (c.north or self._last is not None or m.armed):
            return ()
        if self._requested_ns is not None and now_ns - self._requested_ns < c.request_ns:
            return ()
        self._requested_ns = now_ns
        return self._intervals(m, c.interval_us)

    @staticmethod
    def _intervals(m: Heartbeat, interval_us: int) -> list[MessageInterval]:
        return [MessageInterval(m.system, m.component, i, interval_us) for i in (_ATTITUDE, _POSITION)]

    def on_attitude(self, m: Attitude, now_ns: int) -> tuple[()]:
        """Take the controller's attitude. No answers."""
        self._attitude = m, now_ns
        return ()

    def on_position(self, m: LocalPosition, now_ns: int) -> tuple[()]:
        """Take the controller's position. No answers."""
        self._position = m, now_ns
        return ()

    def in_frame(self, pose: PoseSample, now_ns: int) -> PoseSample | None:
        """The pose in s; None while the frame is not known."""
        if self._first_ns is None:
            self._first_ns = now_ns
        if self._T_s_o is None:
            self._T_s_o = self._choose(pose, now_ns)
        if self._T_s_o is None:
            return None
        T_s_o, R = self._T_s_o, np.eye(6)
        R[:3, :3] = T_s_o[:3, :3]
        return replace(
            pose,
            T_o_b=T_s_o @ pose.T_o_b,
            velocity=None if pose.velocity is None else T_s_o[:3, :3] @ pose.velocity,
            cov=None if pose.cov is None else R @ pose.cov @ R.T,
        )

    def _choose(self, pose: PoseSample, now_ns: int) -> F64 | None:
        c, last = self.config, self._last
        waited_ns = 0 if self._first_ns is None else now_ns - self._first_ns
        armed = self._autopilot is not None and self._autopilot.armed
        if self._autopilot is None and not c.north and waited_ns < c.greeting_ns:
            return None
        goes_on = last is not None or armed
        if not (goes_on or c.north):
            return self._placed(pose, None, 0.0)
        heading_rad = self._heading(pose.t_ns, now_ns)
        if heading_rad is not None:
            # The position only counts in flight: before it, it is that of a filter without poses.
            position = self._position_m(pose.t_ns, now_ns) if goes_on else None
            if position is None and last is not None:
                position = np.array(last.position_m)
            return self._placed(pose, position, heading_rad)
        if last is not None and not c.north and waited_ns >= c.patience_ns:
            return self._placed(pose, np.array(last.position_m), last.heading_rad)
        return None

    def _heading(self, t_ns: int, now_ns: int) -> float | None:
        """The controller's heading at the time of a pose; None if it is not known."""
        if self._attitude is None or now_ns - self._attitude[1] > self.config.fresh_ns:
            return None
        m, received_ns = self._attitude
        return m.angles_rad[2] + m.rate_rad_s[2] * (t_ns - received_ns) * 1e-9

    def _position_m(self, t_ns: int, now_ns: int) -> F64 | None:
        """The controller's position (3,) at the time of a pose; None if it is not known."""
        if self._position is None or now_ns - self._position[1] > self.config.fresh_ns:
            return None
        m, received_ns = self._position
        return np.array(m.position_m) + np.array(m.velocity_m_s) * (t_ns - received_ns) * 1e-9

    def _placed(self, pose: PoseSample, position_m: F64 | None, heading_rad: float) -> F64:
        """T_s_o (4,4) with the vehicle at a position (3,) in local FRD, or where it is in o, and with this heading."""
        T_o_f = pose.T_o_b @ self._T_b_f
        turn = heading_of(T_o_f[:3, :3]) - heading_rad
        R = se3.so3_exp(np.array([0.0, 0.0, turn]))
        if position_m is None:
            return se3.from_rt(R, np.zeros(3))
        return se3.from_rt(R, position_m * [1.0, -1.0, -1.0] - R @ T_o_f[:3, 3])


def heading_of(R_o_f: F64) -> float:
    """Heading (rad, clockwise from x of o, which has z up) of a vehicle; of its right wing where the nose points up."""
    nose, right = R_o_f[:, 0], R_o_f[:, 1]
    if math.hypot(nose[0], nose[1]) > 0.3:
        return -math.atan2(nose[1], nose[0])
    return -math.atan2(right[1], right[0]) - 0.5 * math.pi


def last_pose(T_s_f: F64, *, armed: bool) -> LastPose:
    """What an agent after this one has to know of the controller's pose (4,4) in s."""
    x, y, z = T_s_f[:3, 3].tolist()
    return LastPose((x, -y, -z), heading_of(T_s_f[:3, :3]), armed)

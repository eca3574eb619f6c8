"""Velocity of the vehicle by its last poses, as of an instant after them, where no sensor measures it."""

from collections import deque

from kiteline_core.arrays import F64
from kiteline_core.geometry.end_rates import end_rates

_WINDOW_NS = 250_000_000  # ns of poses that count: longer, and the acceleration is not constant
_AHEAD_NS = 50_000_000  # ns after the last pose up to which its acceleration is believed


class RecentMotion:
    """The poses of the last quarter of a second in the odometry frame."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, F64]] = deque()

    def add(self, t_ns: int, T_o_b: F64, *, measured: bool) -> None:
        """Add the pose (4,4) of a frame. measured: by images; else the earlier ones are forgotten with it."""
        if not measured:
            self._poses.clear()
            return
        while self._poses and t_ns - self._poses[0][0] > _WINDOW_NS:
            self._poses.popleft()
        self._poses.append((t_ns, T_o_b))

    def rates(self, t_ns: int) -> tuple[F64, F64] | None:
        """Velocity (3,) m/s in o and rate (3,) rad/s in b at t_ns; None with fewer than three poses."""
        if len(self._poses) < 3:
            return None
        times, poses = zip(*self._poses, strict=True)
        return end_rates(times, poses, min(t_ns, times[-1] + _AHEAD_NS))

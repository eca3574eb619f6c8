"""Gives the scale filter its intervals: poses by images some frames apart, once the samples between them have come."""

from collections.abc import Callable
from dataclasses import dataclass

from kiteline_agent.inertial.fixed_lag import InertialState
from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.inertial.scale_filter import INTERVAL_S, ScaleFilter, camera_scaled
from kiteline_core.arrays import F64


@dataclass(frozen=True, slots=True)
class _Interval:
    """Poses T_m_b (4,4) by images at two stamps, and the median depth in m of what the later one sees."""

    begin_ns: int
    T_m_b0: F64
    end_ns: int
    T_m_b1: F64
    depth_m: float


class ScaleWatch:
    """Call `see` with each frame placed by images. The filter is as at the end of the last compared interval."""

    def __init__(
        self, scale: ScaleFilter, p_b_c: F64, has_come: Callable[[int], bool],
        samples_between: Callable[[int, int], Samples | None],
    ) -> None:  # fmt: skip
        """p_b_c: (3,) m, camera in the body.

        has_come: whether the samples up to a frame's time have come, but for one or two. samples_between: those between
        two of these times; None with a gap.
        """
        self._filter = scale
        self._p_b_c = p_b_c
        self._has_come, self._samples_between = has_come, samples_between
        self._from: tuple[int, F64] | None = None  # time and pose at which the present interval begins
        self._waiting: _Interval | None = None  # whose last samples have not come
        self._unknown_ns: int | None = None  # time of the first frame since which the state is not known

    def begin(self) -> None:
        """The filter was started at the last frame."""
        self.forget()
        self._unknown_ns = None

    def see(self, t_ns: int, T_m_b: F64, depth_m: float, state: InertialState | None) -> None:
        """Process a frame at T_m_b (4,4) by images, `depth_m` from what they see. state: after it, if it is known."""
        if not self._filter.running:
            return
        if state is None:
            self.forget()
            self._unknown_ns = t_ns if self._unknown_ns is None else self._unknown_ns
            return
        if self._unknown_ns is not None:
            self._filter.wait((t_ns - self._unknown_ns) * 1e-9)
            self._unknown_ns = None
        if self._waiting is not None and self._has_come(self._waiting.end_ns):
            waiting, self._waiting = self._waiting, None
            if not self._compare(waiting, state):
                self.forget()  # the velocity at its end is not known any more
        if self._from is None:
            self._filter.resume(state.velocity)
            self._from = (t_ns, T_m_b)
        elif (t_ns - self._from[0]) * 1e-9 >= INTERVAL_S:
            interval = _Interval(*self._from, t_ns, T_m_b, depth_m)
            if self._waiting is not None:  # samples this late are none
                self.forget()
                self._filter.resume(state.velocity)
            elif not self._has_come(t_ns):
                self._waiting = interval
            elif not self._compare(interval, state):
                self._filter.resume(state.velocity)
            self._from = (t_ns, T_m_b)

    def _compare(self, interval: _Interval, state: InertialState) -> bool:
        """Give the filter an interval; False if that tells nothing."""
        samples = self._samples_between(interval.begin_ns, interval.end_ns)
        if samples is None or interval.depth_m <= 0.0:
            return False
        self._filter.add(interval.T_m_b0, interval.T_m_b1, samples, state.bias[:3], interval.depth_m)
        return True

    def forget(self) -> None:
        """Begin a new interval at the next frame."""
        self._from = self._waiting = None

    def move_map(self, T_new_old: F64) -> None:
        """The map moved: p_new = T_new_old p_old."""
        self._transform(lambda T_m_b: T_new_old @ T_m_b, 1.0)
        self._filter.rotate_map(T_new_old[:3, :3])

    def scale_map(self, factor: float, centre: F64) -> None:
        """Lengths in the map were multiplied by `factor` about centre (3,)."""
        self._transform(lambda T_m_b: camera_scaled(T_m_b, factor, self._p_b_c, centre), factor)
        self._filter.scale_map(factor)

    def _transform(self, change: Callable[[F64], F64], factor: float) -> None:
        if self._from is not None:
            self._from = self._from[0], change(self._from[1])
        w = self._waiting
        if w is not None:
            begin, end = change(w.T_m_b0), change(w.T_m_b1)
            self._waiting = _Interval(w.begin_ns, begin, w.end_ns, end, factor * w.depth_m)

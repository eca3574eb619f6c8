"""Lengths of a window of images and IMU by an odometer, which tells them sooner than accelerations do."""

from collections import deque
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from kiteline_agent.initialisation.window.known_length import KnownLength, extent
from kiteline_agent.initialisation.window.window_state import WindowState
from kiteline_agent.motion.joint_scale import CONTRADICT, contradiction
from kiteline_agent.motion.odometer_samples import MeanVelocity, measured_part
from kiteline_agent.motion.unit_scale import UnitScale
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_STEPS = 128  # more than a window has keyframes
_TOGETHER = 2  # steps that are compared at once: half a second, in which a slow vehicle moves enough
_FLOOR = 0.01  # least relative deviation of lengths: an odometer's own scale
_WELL = 0.09  # (m/s)^2; directions measured worse than this count less and less

Mean = Callable[[int, int], MeanVelocity | None]


class WindowOdometry:
    """Velocities by an odometer between keyframes. Call `add` with each keyframe."""

    def __init__(self, mean: Mean) -> None:
        """mean: of the samples between two stamps."""
        self._mean = mean
        self._last_ns: int | None = None
        self._steps: deque[tuple[int, int, MeanVelocity]] = deque(maxlen=_STEPS)
        self.contradicts = False  # the last window, by more than both deviations allow
        self._events: list[str] = []

    def clear(self) -> None:
        """Forget all."""
        self._steps.clear()
        self._last_ns, self.contradicts = None, False

    def add(self, t_ns: int) -> None:
        """A keyframe with this stamp, whose samples have come."""
        mean = None if self._last_ns is None else self._mean(self._last_ns, t_ns)
        if self._last_ns is not None and mean is not None:
            self._steps.append((self._last_ns, t_ns, mean))
        self._last_ns = t_ns

    def length(self, t_ns: tuple[int, ...], state: WindowState, sigma: float) -> KnownLength | None:
        """Length of the path of a window with these stamps, and its deviation; None if too little tells it.

        sigma: relative deviation of the window's own lengths, infinite if it does not fit. An odometer that contradicts
        them tells nothing.
        """
        found = self._metres_per_unit(t_ns, state)
        if found is None:
            return None
        metres, own = found[0], float(np.hypot(found[1] / found[0], _FLOOR))
        before = self.contradicts
        self.contradicts = abs(float(np.log(metres))) > CONTRADICT * float(np.hypot(own, sigma))
        if self.contradicts and not before:
            self._events.append(contradiction(metres))
        return None if self.contradicts else KnownLength(metres * extent(state.p), own)

    def take_events(self) -> list[str]:
        """Events since the last call, for the log."""
        events, self._events = self._events, []
        return events

    def _metres_per_unit(self, t_ns: tuple[int, ...], state: WindowState) -> tuple[float, float] | None:
        """Metres by the odometer in one of the window, and the deviation of that."""
        means = {(begin, end): mean for begin, end, mean in self._steps}
        unit = UnitScale(_STEPS)
        steps: list[F64] = []
        for k, ends in enumerate(pairwise(t_ns)):
            if ends not in means:
                steps = []
                continue
            steps.append(_displacements(means[ends], (ends[1] - ends[0]) * 1e-9, state, k))
            if len(steps) == _TOGETHER:
                by_odometer, by_window = np.sum(steps, axis=0)
                unit.add(by_odometer, by_window)
                steps = []
        return unit.metres_per_unit()


def _displacements(mean: MeanVelocity, dt_s: float, state: WindowState, k: int) -> F64:
    """(2,3) m from keyframe k to the next one, by odometer and window, in the directions that the odometer measures."""
    R = state.R[k]
    known = R @ measured_part(mean.velocity_cov, _WELL)
    turn = se3.so3_log(R.T @ state.R[k + 1])
    by_odometer = se3.exp(np.concatenate([dt_s * mean.velocity, turn]))[:3, 3]
    return np.array([known @ by_odometer, known @ (R.T @ (state.p[k + 1] - state.p[k]))])

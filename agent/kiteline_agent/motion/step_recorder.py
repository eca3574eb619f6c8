"""Records a monocular flight in short steps, by images and by the IMU, from which the base finds the map's scale.

Only short steps tell it: between keyframes, a second apart, an accelerometer's slow errors are as large as what images
and IMU would have to differ by.
"""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial.inertial_tracker import InertialTracker
from kiteline_agent.inertial.preintegration import preintegrate
from kiteline_codec.schema import InertialSteps
from kiteline_codec.schema.agent.inertial_steps import MAX_STEPS
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId

_LONGEST_S = 2.0  # of a step
_LATEST_S = 2.0  # after a step, until which its samples may come
_LARGEST = 30.0  # of a step's m, m/s: more is no flight, and has no code


@dataclass(frozen=True, slots=True)
class _Step:
    """A step between two stamps. moved: (6,) [rotation, translation m] by images, in the body's axes at its begin."""

    begin_ns: int
    end_ns: int
    moved: F64


@dataclass(frozen=True, slots=True)
class _Mark:
    """A keyframe at the end of a step."""

    keyframe: KeyframeId


class _Break:
    """The steps up to the next keyframe are lost."""


class StepRecorder:
    """Call `see` with each frame placed by images, `mark` with each keyframe, and `take` after both.

    Steps wait until their samples have come.
    """

    def __init__(self, calibration: ImuCalibration, step_s: float) -> None:
        self._calibration = calibration
        self._step_ns = round(step_s * 1e9)
        self._from: tuple[int, F64] | None = None  # stamp and T_m_b where the present step begins
        self._last: tuple[int, F64] | None = None  # newest frame
        self._marked_ns: int | None = None  # stamp of the last keyframe; None after a break
        self._waiting: list[_Step | _Mark | _Break] = []  # in order
        self._newest_ns = 0  # newest stamp of a frame or keyframe
        self._since = NO_KEYFRAME  # the keyframe before the steps that were integrated
        self._steps: list[F64] | None = None  # (13,) each: dt, turn, moved, velocity, position; None: some are lost

    def see(self, t_ns: int, T_m_b: F64) -> None:
        """Append a frame, T_m_b (4,4) by images alone."""
        self._last, self._newest_ns = (t_ns, T_m_b), t_ns
        if self._from is None:
            self._from = self._last
        elif t_ns - self._from[0] >= self._step_ns:
            self._end_step(self._from, self._last)

    def clear(self) -> None:
        """Begin anew after frames without images: the steps up to the next keyframe are lost."""
        self._from = self._last = self._marked_ns = None
        if not self._waiting or not isinstance(self._waiting[-1], _Break):
            self._waiting.append(_Break())

    def restart(self, t_ns: int, T_m_b: F64) -> None:
        """Continue at another pose in the map, or in a new one."""
        if self._marked_ns != t_ns:
            self.clear()
        self._from = self._last = t_ns, T_m_b.copy()

    def move_map(self, T_new_old: F64) -> None:
        """Transform poses after the map moved: p_new = T_new_old p_old."""
        self._from = None if self._from is None else (self._from[0], T_new_old @ self._from[1])
        self._last = None if self._last is None else (self._last[0], T_new_old @ self._last[1])

    def mark(self, keyframe: KeyframeId, t_ns: int) -> None:
        """A keyframe was made of the frame at t_ns: the steps before it are complete."""
        self._newest_ns = t_ns
        if self._last is None or self._last[0] != t_ns:
            self.clear()  # not placed by images: neither the steps before it nor those after it are complete
            self._waiting += [_Mark(keyframe), _Break()]
            return
        if self._from is not None and self._from[0] < t_ns:
            self._end_step(self._from, self._last)
        self._from, self._marked_ns = self._last, t_ns
        self._waiting.append(_Mark(keyframe))

    def take(self, tracker: InertialTracker) -> list[InertialSteps]:
        """The steps between keyframes whose samples have come; without those that are not complete."""
        out: list[InertialSteps] = []
        while self._waiting:
            item = self._waiting[0]
            if isinstance(item, _Step):
                late = self._newest_ns - item.end_ns > _LATEST_S * 1e9
                if not (late or tracker.has_samples(item.end_ns)):
                    break
                self._integrate(item, tracker)
            elif isinstance(item, _Mark):
                out += self._complete(item.keyframe)
            else:
                self._steps = None
            del self._waiting[0]
        return out

    def _end_step(self, begin: tuple[int, F64], end: tuple[int, F64]) -> None:
        moved = se3.inverse(begin[1]) @ end[1]
        self._waiting.append(_Step(begin[0], end[0], np.append(se3.so3_log(moved[:3, :3]), moved[:3, 3])))
        self._from = end

    def _integrate(self, step: _Step, tracker: InertialTracker) -> None:
        samples, state, steps = tracker.samples_between(step.begin_ns, step.end_ns), tracker.state, self._steps
        self._steps = None
        if samples is None or state is None or steps is None or len(steps) >= MAX_STEPS:
            return
        motion = preintegrate(samples, np.concatenate([state.bias[:3], np.zeros(3)]), self._calibration)
        found = np.concatenate([[motion.dt_s], step.moved, motion.vp])
        if motion.dt_s < _LONGEST_S and bool((np.abs(found) < _LARGEST).all()):
            self._steps = [*steps, found]

    def _complete(self, keyframe: KeyframeId) -> list[InertialSteps]:
        """The steps up to a keyframe, if they are complete. The next ones begin there."""
        steps, since = self._steps, self._since
        self._steps, self._since = [], keyframe
        if not steps or since >= keyframe:
            return []
        columns = np.array(steps)
        return [
            InertialSteps(
                keyframe, since, self._calibration.accel_noise, columns[:, 0], columns[:, 1:4], columns[:, 4:7],
                columns[:, 7:10], columns[:, 10:],
            )
        ]  # fmt: skip

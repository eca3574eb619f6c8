"""Records a monocular flight in short steps, by images and by the IMU, from which the base finds the map's scale.

Only short steps tell it: between keyframes, a second apart, an accelerometer's slow errors are as large as what images
and IMU would have to differ by.
"""

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
_LARGEST = 30.0  # of a step's m, m/s: more is no flight, and has no code


class StepRecorder:
    """Call `see` with each frame placed by images, and `take` with each keyframe."""

    def __init__(self, calibration: ImuCalibration, step_s: float) -> None:
        self._calibration = calibration
        self._step_ns = round(step_s * 1e9)
        self._steps: list[F64] = []  # (13,) each: dt, turn, moved, velocity, position
        self._from: tuple[int, F64] | None = None  # stamp and T_m_b where the present step begins
        self._last: tuple[int, F64] | None = None  # newest frame
        self._since: tuple[KeyframeId, int] = NO_KEYFRAME, 0  # keyframe before the steps, and its stamp

    def see(self, t_ns: int, T_m_b: F64, tracker: InertialTracker) -> None:
        """Append a frame, T_m_b (4,4) by images alone."""
        self._last = t_ns, T_m_b
        if self._from is None:
            self._from = self._last
        elif t_ns - self._from[0] >= self._step_ns:
            self._end_step(tracker)

    def clear(self) -> None:
        """Begin anew after frames without images: the steps up to the next keyframe are lost."""
        self._steps, self._from, self._last = [], None, None
        self._since = NO_KEYFRAME, 0

    def restart(self, t_ns: int, T_m_b: F64) -> None:
        """Continue at another pose in the map, or in a new one."""
        if self._since[1] != t_ns:
            self.clear()
        self._from = self._last = t_ns, T_m_b.copy()

    def move_map(self, T_new_old: F64) -> None:
        """Transform poses after the map moved: p_new = T_new_old p_old."""
        self._from = None if self._from is None else (self._from[0], T_new_old @ self._from[1])
        self._last = None if self._last is None else (self._last[0], T_new_old @ self._last[1])

    def take(self, keyframe: KeyframeId, t_ns: int, tracker: InertialTracker) -> InertialSteps | None:
        """The steps from the keyframe before to this one; None if they are not complete."""
        seen = self._last is not None and self._last[0] == t_ns
        if seen and self._from is not None and self._from[0] < t_ns:
            self._end_step(tracker)
        steps, since = self._steps, self._since[0]
        self._steps, self._since = [], (keyframe, t_ns)
        self._from = self._last if seen else None
        if not seen or since == NO_KEYFRAME or since >= keyframe or not 0 < len(steps) <= MAX_STEPS:
            return None
        columns = np.array(steps)
        return InertialSteps(
            keyframe, since, self._calibration.accel_noise, columns[:, 0], columns[:, 1:4], columns[:, 4:7],
            columns[:, 7:10], columns[:, 10:],
        )  # fmt: skip

    def _end_step(self, tracker: InertialTracker) -> None:
        assert self._from is not None and self._last is not None
        (begin_ns, T_m_b0), (end_ns, T_m_b1) = self._from, self._last
        samples, state = tracker.samples_between(begin_ns, end_ns), tracker.state
        if samples is not None and state is not None and len(self._steps) < MAX_STEPS:
            motion = preintegrate(samples, np.concatenate([state.bias[:3], np.zeros(3)]), self._calibration)
            moved = se3.inverse(T_m_b0) @ T_m_b1
            step = np.concatenate([[motion.dt_s], se3.so3_log(moved[:3, :3]), moved[:3, 3], motion.vp])
            if motion.dt_s < _LONGEST_S and bool((np.abs(step) < _LARGEST).all()):
                self._steps.append(step)
                self._from = self._last
                return
        last = self._last
        self.clear()
        self._from = self._last = last

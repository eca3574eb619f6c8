"""The IMU samples between the keyframes of a window, at any time offset."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer, without_held
from kiteline_core.arrays import F64

_RATE_NS = 10_000_000  # ns on each side of a stamp over which its rate is averaged: vibration is faster
_MOST_S = 0.5  # s; change of the time offset: a solver that diverges asks for more


class WindowSamples:
    """Samples of K - 1 intervals, of those in the buffer now: a solution goes on while others come."""

    def __init__(
        self, buffer: SampleBuffer, correct: Callable[[Samples], Samples], stamps_ns: Sequence[int], about_s: float
    ) -> None:  # fmt: skip
        """correct: applied to each interval. stamps_ns: K camera stamps. about_s: a time offset near the right one."""
        self._about_s = about_s
        self._buffer = buffer.extended(None)
        self._correct = correct
        self._stamps_ns = stamps_ns
        self._cut: dict[int, list[Samples | None]] = {}  # by offset in ns: several solutions ask for it

    def at(self, offset_s: float) -> list[Samples] | None:
        """The samples if camera stamps + offset_s are the IMU's time; None if some are missing."""
        found = self._between(offset_s)
        complete = [self._correct(samples) for samples in found if samples is not None]
        if len(complete) < len(found):
            return None
        late = self._buffer.lacks(self._stamps_ns[-1] + round(offset_s * 1e9))
        return [*complete[:-1], without_held(complete[-1])] if late else complete

    @property
    def stamps_s(self) -> F64:
        """(K,) the camera's stamps after the first one."""
        return 1e-9 * (np.array(self._stamps_ns) - self._stamps_ns[0])

    def rates(self, offset_s: float) -> F64:
        """Angular velocity (K,3) rad/s by the gyro, with its bias, in the body at each stamp; NaN without samples."""
        out = np.full((len(self._stamps_ns), 3), np.nan)
        for k, stamp_ns in enumerate(self._stamps_ns):
            at_ns = stamp_ns + round(offset_s * 1e9)
            samples = self._buffer.between(at_ns - _RATE_NS, at_ns + _RATE_NS)
            if samples is not None:
                t_s, gyro = samples.t_s, self._correct(samples).gyro
                out[k] = 0.5 * np.diff(t_s) @ (gyro[1:] + gyro[:-1]) / t_s[-1]
        return out

    def missing(self, offset_s: float) -> int | None:
        """The last interval that lacks samples; None if none does."""
        lacking = [k for k, samples in enumerate(self._between(offset_s)) if samples is None]
        return lacking[-1] if lacking else None

    def _between(self, offset_s: float) -> list[Samples | None]:
        if not abs(offset_s - self._about_s) < _MOST_S:
            return [None]
        offset_ns = round(offset_s * 1e9)
        if offset_ns not in self._cut:
            found = [self._buffer.between(a + offset_ns, b + offset_ns) for a, b in pairwise(self._stamps_ns)]
            self._cut[offset_ns] = found
        return self._cut[offset_ns]

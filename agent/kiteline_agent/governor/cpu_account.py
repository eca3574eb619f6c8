"""What an agent's frames cost in CPU time, decoding taken off. Pure: the clock is handed in."""

from __future__ import annotations

from collections.abc import Callable

from kiteline_agent.runtime.frame_reader import FrameReader


class CpuAccount:
    """CPU time a frame.

    clock: process CPU time in ns. whole: the agent is alone in its process, so that all CPU time between two frames is
    its own; otherwise only the time inside its steps is. ms: a frame each. last_ns: what the last one took.
    """

    def __init__(self, clock: Callable[[], int], camera: FrameReader, whole: bool) -> None:
        self._clock = clock
        self._camera = camera
        self._whole = whole
        self._mark_ns = clock()
        self._decode_mark_ns = camera.decode_ns
        self._spent_ns = 0
        self.ms: list[float] = []
        self.last_ns = 0

    def begin(self) -> None:
        """A step begins."""
        if not self._whole:
            self._mark_ns = self._clock()

    def end(self, with_frame: bool) -> None:
        """It ended."""
        end_ns = self._clock()
        self._spent_ns += end_ns - self._mark_ns
        if self._whole:
            self._spent_ns -= self._camera.decode_ns - self._decode_mark_ns
        self._mark_ns, self._decode_mark_ns = end_ns, self._camera.decode_ns
        if with_frame:
            self.ms.append(self._spent_ns / 1e6)
            self.last_ns, self._spent_ns = self._spent_ns, 0

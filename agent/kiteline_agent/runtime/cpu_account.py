"""CPU time of each frame of an agent, without image decoding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Decoder(Protocol):
    """What reads frames."""

    @property
    def decode_ns(self) -> int:
        """Process CPU spent on reading and decoding so far."""
        ...


class CpuAccount:
    """Measures the CPU time of each frame.

    clock: process CPU time in ns. whole: the agent is alone in its process, so that all CPU time between two frames
    counts; otherwise only that inside its steps. ms: of each frame. last_ns: of the last one.
    """

    def __init__(self, clock: Callable[[], int], camera: Decoder, whole: bool) -> None:
        self._clock = clock
        self._camera = camera
        self._whole = whole
        self._mark_ns = clock()
        self._decode_mark_ns = camera.decode_ns
        self._spent_ns = 0
        self.ms: list[float] = []
        self.last_ns = 0

    def begin(self) -> None:
        """Start of a step."""
        if not self._whole:
            self._mark_ns = self._clock()

    def end(self, with_frame: bool) -> None:
        """End of a step; with_frame: a frame was processed."""
        end_ns = self._clock()
        self._spent_ns += end_ns - self._mark_ns
        if self._whole:
            self._spent_ns -= self._camera.decode_ns - self._decode_mark_ns
        self._mark_ns, self._decode_mark_ns = end_ns, self._camera.decode_ns
        if with_frame:
            self.ms.append(self._spent_ns / 1e6)
            self.last_ns, self._spent_ns = self._spent_ns, 0

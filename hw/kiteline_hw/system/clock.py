"""The clocks of the live programs."""

from __future__ import annotations

import time


class MonotonicClock:
    """CLOCK_MONOTONIC: the clock that stamps V4L2 frames, and that no one sets."""

    def now_ns(self) -> int:
        """Nanoseconds since some moment before the program started."""
        return time.monotonic_ns()


class ManualClock:
    """A clock that is set by hand."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        """What it was set to."""
        return self._now_ns

    def set(self, now_ns: int) -> None:
        """Set it; it never goes back (ValueError)."""
        if now_ns < self._now_ns:
            raise ValueError(f"a clock at {self._now_ns} ns cannot be set back to {now_ns} ns")
        self._now_ns = now_ns

"""The clock of the live programs."""

import time


class MonotonicClock:
    """CLOCK_MONOTONIC: the clock that also stamps V4L2 frames, and that is never set."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary moment before the program started."""
        return time.monotonic_ns()

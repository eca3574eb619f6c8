"""When poses and obstacles go to a flight controller. No clock."""


class PoseSchedule:
    """Times at a fixed rate. A late one does not delay those after it."""

    def __init__(self, rate_hz: float, begin_ns: int) -> None:
        """rate_hz: 0: never."""
        self._period_ns = round(1e9 / rate_hz) if rate_hz > 0.0 else 0
        self._next_ns = begin_ns

    @property
    def next_ns(self) -> int | None:
        """The next time; None: never."""
        return self._next_ns if self._period_ns else None

    def take_due(self, now_ns: int) -> bool:
        """True if one is due, which then counts as sent."""
        if not self._period_ns or now_ns < self._next_ns:
            return False
        self._next_ns += ((now_ns - self._next_ns) // self._period_ns + 1) * self._period_ns
        return True

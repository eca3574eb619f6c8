"""Virtual CPU: the time at which a limited core is free again."""


class VirtualCpu:
    """A core of which `percent` are available, in order of work; 0: it is never busy."""

    def __init__(self, percent: float) -> None:
        self._percent = percent
        self.free_ns = 0

    def spend(self, ops: int, now_ns: int) -> None:
        """Queue work that is ready at `now_ns`."""
        if self._percent > 0.0:
            self.free_ns = max(now_ns, self.free_ns) + round(ops * 100.0 / self._percent)

    def newest_wins(self, frame_ns: int, period_ns: int) -> bool:
        """True if a frame is dropped because the next one arrives before the core is free."""
        return period_ns > 0 and self.free_ns >= frame_ns + period_ns

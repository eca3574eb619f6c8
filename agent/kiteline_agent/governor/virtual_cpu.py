"""The virtual CPU: when a limited core is free again. Pure; cost_model.py says what work costs."""

from __future__ import annotations


class VirtualCpu:
    """A core of which `percent` are ours; 0: it is never busy. Work is done in order."""

    def __init__(self, percent: float) -> None:
        self._percent = percent
        self.free_ns = 0

    def spend(self, ops: int, now_ns: int) -> None:
        """Do work that was ready at `now_ns`."""
        if self._percent > 0.0:
            self.free_ns = max(now_ns, self.free_ns) + round(ops * 100.0 / self._percent)

    def newest_wins(self, frame_ns: int, period_ns: int) -> bool:
        """Whether a frame is passed over: before the core is free to take it up, the next one is there."""
        return period_ns > 0 and self.free_ns >= frame_ns + period_ns

"""How long a packet and its acknowledgement take, and how long to wait for one."""

from __future__ import annotations

from kiteline_codec.sync.config import SyncConfig

_MOST_DOUBLINGS = 6  # of the patience, while nothing is heard


class RoundTrip:
    """Smoothed round trip and its deviation (RFC 6298)."""

    def __init__(self, config: SyncConfig) -> None:
        self._config = config
        self.mean_ns = self._deviation_ns = 0  # 0: not measured yet
        self.doublings = 0

    def measured(self, rtt_ns: int) -> None:
        """A round trip; whoever answers is waited for no longer than usual."""
        self.doublings = 0
        if not self.mean_ns:
            self.mean_ns, self._deviation_ns = max(1, rtt_ns), rtt_ns // 2
            return
        self._deviation_ns += (abs(rtt_ns - self.mean_ns) - self._deviation_ns) // 4
        self.mean_ns = max(1, self.mean_ns + (rtt_ns - self.mean_ns) // 8)

    def missed(self) -> None:
        """Nothing was heard in time: wait longer for the next."""
        self.doublings = min(self.doublings + 1, _MOST_DOUBLINGS)

    @property
    def overdue_ns(self) -> int:
        """Time after which a packet that later ones have overtaken is lost (as RFC 9002)."""
        return self.mean_ns + max(self.mean_ns // 4, 2 * self._deviation_ns)

    @property
    def timeout_ns(self) -> int:
        """Time after which a packet that nothing is heard of is lost."""
        c = self._config
        base = self.mean_ns + 4 * self._deviation_ns + c.ack_delay_ns if self.mean_ns else c.first_rto_ns
        return min(max(base, c.min_rto_ns) << self.doublings, c.max_rto_ns)

"""The round-trip time of packets, and the time-outs that follow from it."""

from kiteline_codec.sync.config import SyncConfig

_MAX_DOUBLINGS = 6  # of the time-out while nothing is acknowledged


class RoundTrip:
    """Smoothed round-trip time and its deviation (RFC 6298)."""

    def __init__(self, config: SyncConfig) -> None:
        self._config = config
        self.mean_ns: int | None = None  # None before the first measurement
        self._deviation_ns = 0
        self.doublings = 0

    def measured(self, rtt_ns: int) -> None:
        """Take in a measurement; the time-out is no longer doubled."""
        self.doublings = 0
        if self.mean_ns is None:
            self.mean_ns, self._deviation_ns = max(1, rtt_ns), rtt_ns // 2
            return
        self._deviation_ns += (abs(rtt_ns - self.mean_ns) - self._deviation_ns) // 4
        self.mean_ns = max(1, self.mean_ns + (rtt_ns - self.mean_ns) // 8)

    def timed_out(self) -> None:
        """Double the time-out."""
        self.doublings = min(self.doublings + 1, _MAX_DOUBLINGS)

    @property
    def overdue_ns(self) -> int:
        """Time after which a packet that later ones have overtaken is lost (as RFC 9002)."""
        mean_ns = self.mean_ns or 0
        return mean_ns + max(mean_ns // 4, 2 * self._deviation_ns)

    @property
    def probe_ns(self) -> int | None:
        """Time after which the last packets of all are sent again (RFC 8985); None before the first measurement."""
        return None if self.mean_ns is None else self.overdue_ns + self._config.ack_delay_ns

    @property
    def timeout_ns(self) -> int:
        """Time after which an unacknowledged packet is lost."""
        c = self._config
        mean_ns = self.mean_ns
        base = c.first_rto_ns if mean_ns is None else mean_ns + 4 * self._deviation_ns + c.ack_delay_ns
        return min(max(base, c.min_rto_ns) << self.doublings, c.max_rto_ns)

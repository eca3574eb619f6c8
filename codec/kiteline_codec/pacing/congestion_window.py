"""A congestion window for links without a byte budget. Pure.

Packets that queue in a modem or router delay everything, the pose too. So the window follows the delay, as in TCP
Vegas (L. Brakmo, L. Peterson, 1995): it grows while round trips stay near the recent minimum and shrinks otherwise.
Losses do not shrink it: radios lose packets without being congested.
"""

_FIRST_PACKETS = 10  # a keyframe of the wide profile
_LEAST_PACKETS = 3
_USED = 0.75  # share of the window that must be in flight for it to grow
_QUEUE_NS = 250_000_000  # ns that packets may queue on the path
_MEMORY_NS = 60_000_000_000  # ns for which a minimum holds, at least: paths change


class CongestionWindow:
    """The number of packets that may be in flight. most: packets that one acknowledgement covers."""

    def __init__(self, most: int) -> None:
        self._most = most
        self.packets = min(_FIRST_PACKETS, most)
        self._shortest_ns: int | None = None  # minimum round trip of this period
        self._before_ns: int | None = None  # of the period before
        self._since_ns = 0
        self._shrunk_ns: int | None = None  # when the window shrank last

    def measured(self, rtt_ns: int, acked: int, in_flight: int, now_ns: int) -> None:
        """Take in the round trip of the oldest of `acked` packets, out of `in_flight` before."""
        if self._shortest_ns is None or now_ns - self._since_ns > _MEMORY_NS:
            self._before_ns, self._shortest_ns, self._since_ns = self._shortest_ns, rtt_ns, now_ns
        self._shortest_ns = min(self._shortest_ns, rtt_ns)
        floor_ns = self._shortest_ns if self._before_ns is None else min(self._shortest_ns, self._before_ns)
        if rtt_ns <= floor_ns + _QUEUE_NS:
            if in_flight >= self.packets * _USED:  # an unused window proves nothing about the link
                self.packets = min(self.packets + acked, self._most)
        elif self._shrunk_ns is None or now_ns - self._shrunk_ns >= rtt_ns:
            self.packets = max(_LEAST_PACKETS, self.packets * (floor_ns + _QUEUE_NS) // rtt_ns)
            self._shrunk_ns = now_ns

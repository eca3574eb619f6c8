"""How many packets may be on their way on a link of which nobody said what it carries. Pure.

Packets that wait in a modem or router make everything late, the pose too. So the window follows the delay, as in TCP
Vegas (L. Brakmo, L. Peterson, 1995): it grows while round trips stay near the shortest of late, and shrinks when they
do not. Losses do not shrink it: radios lose packets without being full.
"""

from __future__ import annotations

_FIRST_PACKETS = 10  # a keyframe of the wide profile
_LEAST_PACKETS = 3
_USED = 0.75  # share of the window that must be on its way for it to grow
_QUEUE_NS = 250_000_000  # ns that packets may wait somewhere on the way
_MEMORY_NS = 60_000_000_000  # ns for which a shortest round trip is believed, at least: ways change


class Window:
    """The window of one relation. most: packets that one acknowledgement can tell of."""

    def __init__(self, most: int) -> None:
        self._most = most
        self.packets = min(_FIRST_PACKETS, most)
        self._shortest_ns: int | None = None  # round trip in this span of time
        self._before_ns: int | None = None  # in the span before
        self._since_ns = 0
        self._shrunk_ns = 0  # when the window shrank last

    def measured(self, rtt_ns: int, acked: int, on_way: int, now_ns: int) -> None:
        """Of so many packets on their way so many were acknowledged; the oldest took so long there and back."""
        if self._shortest_ns is None or now_ns - self._since_ns > _MEMORY_NS:
            self._before_ns, self._shortest_ns, self._since_ns = self._shortest_ns, rtt_ns, now_ns
        self._shortest_ns = min(self._shortest_ns, rtt_ns)
        floor_ns = self._shortest_ns if self._before_ns is None else min(self._shortest_ns, self._before_ns)
        if rtt_ns <= floor_ns + _QUEUE_NS:
            if on_way >= self.packets * _USED:  # a window that is not used says nothing of what the link could carry
                self.packets = min(self.packets + acked, self._most)
        elif now_ns - self._shrunk_ns >= rtt_ns:
            self.packets = max(_LEAST_PACKETS, self.packets * (floor_ns + _QUEUE_NS) // rtt_ns)
            self._shrunk_ns = now_ns

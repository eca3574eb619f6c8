"""The throughput of a link, measured by acknowledgements. Pure."""

from collections import deque

_WINDOW_NS = 2_000_000_000  # ns over which deliveries are counted


class Throughput:
    """Bytes acknowledged over the last two seconds, while there was always more to send."""

    def __init__(self) -> None:
        self._acked: deque[tuple[int, int]] = deque()
        self._sum = 0
        self._busy_since_ns: int | None = None

    def acked(self, n_bytes: int, now_ns: int) -> None:
        """Note bytes that are known to have arrived."""
        self._acked.append((now_ns, n_bytes))
        self._sum += n_bytes

    def busy(self, backlog: bool, now_ns: int) -> None:
        """Note whether values wait to be sent."""
        if not backlog:
            self._busy_since_ns = None
        elif self._busy_since_ns is None:
            self._busy_since_ns = now_ns

    def bytes_s(self, now_ns: int) -> int | None:
        """Bytes per second that the link delivers; None while unknown, because nothing had to wait."""
        while self._acked and now_ns - self._acked[0][0] > _WINDOW_NS:
            self._sum -= self._acked.popleft()[1]
        if self._busy_since_ns is None or now_ns - self._busy_since_ns < _WINDOW_NS:
            return None
        return self._sum * 1_000_000_000 // _WINDOW_NS

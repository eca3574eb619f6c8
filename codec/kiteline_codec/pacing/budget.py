"""A byte budget that holds in every one-second window, wherever the window begins, and is spent evenly."""

from collections import deque

WINDOW_NS = 1_000_000_000


class SlidingBudget:
    """Bytes within the last second, both ends included, of which `burst_bytes` at once. Limit None means unlimited.

    The window alone would let a sender spend a second's bytes at once and then wait for a second; the bucket, which
    fills at the rate of the limit, spreads them, so that a new value waits no longer than a packet takes.
    """

    def __init__(self, limit_bytes: int | None, burst_bytes: int) -> None:
        self._limit = limit_bytes
        self._burst = min(burst_bytes, limit_bytes or 0)
        self._spent: deque[tuple[int, int]] = deque()
        self._sum = 0
        self._bucket = self._burst * WINDOW_NS  # byte nanoseconds, integers: exact
        self._filled_ns: int | None = None

    def left(self, now_ns: int) -> int:
        """Bytes that may be sent now."""
        if self._limit is None:
            return 1 << 30
        while self._spent and now_ns - self._spent[0][0] > WINDOW_NS:
            self._sum -= self._spent.popleft()[1]
        if self._filled_ns is not None:
            more = max(0, now_ns - self._filled_ns) * self._limit
            self._bucket = min(self._burst * WINDOW_NS, self._bucket + more)
        self._filled_ns = now_ns
        return min(self._limit - self._sum, self._bucket // WINDOW_NS)

    def spend(self, now_ns: int, n_bytes: int) -> None:
        """Note bytes that are sent now."""
        if self._limit is None:
            return
        self._sum += n_bytes
        self._bucket -= n_bytes * WINDOW_NS
        if self._spent and self._spent[-1][0] == now_ns:
            n_bytes += self._spent.pop()[1]
        self._spent.append((now_ns, n_bytes))

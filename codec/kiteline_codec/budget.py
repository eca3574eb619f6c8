"""A byte budget that holds in every one-second window, wherever the window begins."""

from __future__ import annotations

from collections import deque

WINDOW_NS = 1_000_000_000


class SlidingBudget:
    """Bytes spent within the last second, both ends of the window included. A limit of 0 means unlimited."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._spent: deque[tuple[int, int]] = deque()
        self._sum = 0

    def left(self, now_ns: int) -> int:
        """How many bytes may be sent now."""
        if not self._limit:
            return 1 << 30
        while self._spent and now_ns - self._spent[0][0] > WINDOW_NS:
            self._sum -= self._spent.popleft()[1]
        return self._limit - self._sum

    def spend(self, now_ns: int, n_bytes: int) -> None:
        """Book bytes that are sent now."""
        if not self._limit:
            return
        self._sum += n_bytes
        if self._spent and self._spent[-1][0] == now_ns:
            n_bytes += self._spent.pop()[1]
        self._spent.append((now_ns, n_bytes))

"""Rows and slots that were freed, for the next ones that are needed."""

from bisect import bisect_left, insort
from collections.abc import Iterable


class FreeRuns:
    """Runs of free numbers. A run that is needed is cut from the smallest one that holds it."""

    def __init__(self) -> None:
        self._runs: list[tuple[int, int]] = []  # length and begin, shortest first

    def __bool__(self) -> bool:
        return bool(self._runs)

    def take(self, length: int = 1) -> int | None:
        """The begin of a run of this length; None if there is none so long."""
        at = bisect_left(self._runs, (length, -1))
        if at == len(self._runs):
            return None
        held, begin = self._runs.pop(at)
        if held > length:
            insort(self._runs, (held - length, begin + length))
        return begin

    def free(self, runs: Iterable[tuple[int, int]]) -> None:
        """Add runs (length, begin) of numbers that are in use no more; neighbours are joined."""
        joined: list[tuple[int, int]] = []
        for begin, length in sorted((begin, length) for length, begin in [*self._runs, *runs] if length):
            if joined and sum(joined[-1]) == begin:
                joined[-1] = joined[-1][0], joined[-1][1] + length
            else:
                joined.append((begin, length))
        self._runs = sorted((length, begin) for begin, length in joined)

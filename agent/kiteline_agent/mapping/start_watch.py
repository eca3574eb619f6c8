"""Says why no map begins, with stereo or depth images and with one camera alone."""

from kiteline_agent.keyframes.pair_search import Fault

_AFTER_S = 1.0  # s that no map begins before it is said: first images may be dark
VIEWS_S = 10.0  # s the same of one camera, which may stand still at first


class StartWatch:
    """Says each fault once in a flight, when no map could begin for a while."""

    def __init__(self, after_s: float = _AFTER_S) -> None:
        self._after_ns = round(1e9 * after_s)
        self._since_ns: int | None = None  # of the first frame with which no map could begin
        self._said: set[Fault] = set()

    def note(self, t_ns: int, fault: Fault | None) -> list[str]:
        """Take in the fault of a frame, None if a map begins or nothing is known. Returns what is to be said."""
        if fault is None:
            self._since_ns = None
            return []
        self._since_ns = t_ns if self._since_ns is None else self._since_ns
        if fault in self._said or t_ns - self._since_ns < self._after_ns:
            return []
        self._said.add(fault)
        return [fault.value]

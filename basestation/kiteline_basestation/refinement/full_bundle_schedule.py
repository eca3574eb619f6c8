"""When whole maps are bundled: whenever one has grown since, as far as the worker's time allows.

Local bundles look no further than a window, and the offsets of disparities show in whole maps alone. So that a map
depends on what was seen, and not on the moment at which it is asked for, none stays long without such a bundle; in a
quiet moment the last one sees all keyframes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from kiteline_basestation.config import GraphConfig
from kiteline_core.ids import SubmapId


class FullBundleSchedule:
    """Which map is next, and when. Maps are named by their eldest submap, their size is their number of keyframes."""

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self.bundled: dict[SubmapId, int] = {}  # the size of each when it was last asked for
        self._rest_until_ns = 0

    def next(self, sizes: Mapping[SubmapId, int], busy: Collection[SubmapId], now_ns: int) -> SubmapId | None:
        """The map that has grown by the largest share, if one has and the worker may be asked. busy: not these."""
        waiting = [m for m in self.waiting(sizes) if m not in busy]
        if not waiting or now_ns < self._rest_until_ns:
            return None
        chosen = max(waiting, key=lambda m: abs(sizes[m] - self.bundled.get(m, 0)) / sizes[m])
        self.bundled[chosen] = sizes[chosen]
        return chosen

    def waiting(self, sizes: Mapping[SubmapId, int]) -> list[SubmapId]:
        """Maps that are not as they were when they were last asked for."""
        return [m for m in sorted(sizes) if sizes[m] >= self._config.first_full and sizes[m] != self.bundled.get(m, 0)]

    def done(self, cost_ops: int, now_ns: int) -> None:
        """A bundle of a whole map has come back: the worker has other things to do for a while."""
        self._rest_until_ns = now_ns + round(cost_ops / self._config.full_share)

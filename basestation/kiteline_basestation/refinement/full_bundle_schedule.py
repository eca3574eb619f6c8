"""Schedules full bundles: a map is bundled as a whole when it has grown and the worker has time.

Over a thin link a keyframe's observations arrive seconds after its header: a map has grown when they do.
Local bundles see a window only, and disparity offsets are observable in whole maps only. The last full bundle of a
quiet base includes all keyframes, so that the map does not depend on when it is read.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from kiteline_basestation.config import GraphConfig
from kiteline_core.ids import SubmapId


class FullBundleSchedule:
    """Chooses the next map. The size of a map is the number of its keyframes and keypoints that have arrived."""

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self.bundled: dict[SubmapId, int] = {}  # size of each map at its last full bundle
        self._rest_until_ns = 0

    def next(self, sizes: Mapping[SubmapId, int], busy: Collection[SubmapId], now_ns: int) -> SubmapId | None:
        """The map, none of `busy`, that has grown by the largest share; None if none has or the worker shall rest."""
        waiting = [m for m in self.waiting(sizes) if m not in busy]
        if not waiting or now_ns < self._rest_until_ns:
            return None
        chosen = max(waiting, key=lambda m: abs(sizes[m] - self.bundled.get(m, 0)) / sizes[m])
        self.bundled[chosen] = sizes[chosen]
        return chosen

    def waiting(self, sizes: Mapping[SubmapId, int]) -> list[SubmapId]:
        """Maps whose size has changed since their last full bundle."""
        return [m for m in sorted(sizes) if sizes[m] != self.bundled.get(m, 0)]

    def done(self, cost_ops: int, now_ns: int) -> None:
        """Let the worker rest from full bundles in proportion to the cost of the one that is done."""
        self._rest_until_ns = now_ns + round(cost_ops / self._config.full_share)

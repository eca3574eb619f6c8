"""Schedules full bundles: a map is bundled as a whole when it has grown and the worker has time; a large one in parts.

Over a thin link a keyframe's observations arrive seconds after its header: a map has grown when they do.
Local bundles see a window only, and disparity offsets are observable in whole maps only. The last full bundle of a
quiet base includes all keyframes, so that the map does not depend on when it is read.
"""

from collections.abc import Collection, Mapping

from kiteline_basestation.config import GraphConfig
from kiteline_core.ids import SubmapId

Part = tuple[SubmapId, int]  # (map, 0): a whole map; of a large one (submap, number): keyframes of it in a row


class FullBundleSchedule:
    """Chooses the next map, or part. Its size is the number of its keyframes and keypoints that have arrived."""

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self.bundled: dict[Part, int] = {}  # size of each at its last full bundle
        self._rest_until_ns = 0

    def next(self, sizes: Mapping[Part, int], busy: Collection[Part], now_ns: int) -> Part | None:
        """The map or part, none of `busy`, that has grown by the largest share.

        None if none has, or the worker shall rest.
        """
        waiting = [m for m in self.waiting(sizes) if m not in busy]
        if not waiting or now_ns < self._rest_until_ns:
            return None
        chosen = max(waiting, key=lambda m: abs(sizes[m] - self.bundled.get(m, 0)) / sizes[m])
        self.bundled[chosen] = sizes[chosen]
        return chosen

    def waiting(self, sizes: Mapping[Part, int]) -> list[Part]:
        """Maps and parts whose size has changed since their last full bundle."""
        return [m for m in sorted(sizes) if sizes[m] != self.bundled.get(m, 0)]

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Make all parts of submaps due again."""
        self.bundled = {part: size for part, size in self.bundled.items() if part[0] not in submaps}

    def done(self, cost_ops: int, now_ns: int) -> None:
        """Let the worker rest from full bundles in proportion to the cost of the one that is done."""
        self._rest_until_ns = now_ns + round(cost_ops / self._config.full_share)

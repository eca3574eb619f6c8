"""Landmarks of the local map that the base found to be one with another one, their root."""

import numpy as np

from kiteline_agent.local_map.local_map import LocalMap
from kiteline_codec.schema import FusedLandmarks
from kiteline_core.ids import KEYPOINT_BITS, NO_KEYFRAME, KeyframeId


class FusedInMap:
    """Stops the search for landmarks whose root is stored, too, once the base has set the poses of both keyframes.

    Until then the two lie apart by the drift between their keyframes: the newer one is where the camera sees it.
    Like all corrections it waits until these matter.
    """

    def __init__(self, local_map: LocalMap) -> None:
        self._map = local_map
        self._told: dict[KeyframeId, FusedLandmarks] = {}  # of keyframes that are stored

    def take(self, record: FusedLandmarks) -> None:
        """Hold what the base found ready for `corrected`."""
        self._told[record.keyframe] = record
        self._told = {k: held for k, held in self._told.items() if self._map.slot_of(k) >= 0}

    def corrected(self) -> None:
        """The base has set poses of the map."""
        for record in self._told.values():
            self._drop(record)

    def _drop(self, record: FusedLandmarks) -> None:
        m, slot = self._map, self._map.slot_of(record.keyframe)
        # where the base has set the pose, or that defines the submap
        placed = (m.keyframe != NO_KEYFRAME) & (m.from_base | (m.parent == NO_KEYFRAME))
        if slot < 0 or not placed[slot]:
            return
        has_root = np.isin(record.point >> KEYPOINT_BITS, m.keyframe[placed])
        fused = record.index[(record.index < m.shared[slot]) & has_root]
        m.usable[slot, fused] = m.seed[slot, fused] = False

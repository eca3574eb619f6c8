"""A keyframe that the base sends down into an agent's map cache."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import MAX_SUBMAP_ID, IdOf, Key, Priority, Record, register
from kiteline_core.ids import KeyframeId, SubmapId


@register
@dataclass(frozen=True, slots=True)
class CachedKeyframe(Record):
    """A keyframe of another agent, or one that its agent evicted. T_m_k: (4,4) camera in the receiver's `submap`."""

    KIND = 23
    ID = IdOf.CACHED_KEYFRAME
    PRIORITY = Priority.REST

    keyframe: KeyframeId
    submap: SubmapId
    T_m_k: NDArray[np.float64]

    def write(self, out: Writer) -> None:
        """Append submap and pose."""
        out.varint(self.submap)
        write_pose(out, self.T_m_k)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        submap = SubmapId(source.varint(MAX_SUBMAP_ID))
        return cls(KeyframeId(key.id), submap, read_pose(source))

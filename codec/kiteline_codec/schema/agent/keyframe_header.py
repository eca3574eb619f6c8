"""The header of a keyframe: time, parent and pose relative to the parent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader, WireError, Writer, unzigzag, zigzag
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import MAX_KEYFRAME_ID, IdOf, Key, Priority, Record, register
from kiteline_core.ids import MAX_KEYPOINTS, NO_KEYFRAME, KeyframeId


@register
@dataclass(frozen=True, slots=True)
class KeyframeHeader(Record):
    """A keyframe's header. T_p_k: (4,4) this keyframe's camera in its parent's; for the first of a submap
    (parent NO_KEYFRAME) in the submap frame m, whose z points up.
    """

    KIND = 3
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.KEYFRAME
    PREDICTS = True

    keyframe: KeyframeId
    t_ns: int
    parent: KeyframeId
    T_p_k: NDArray[np.float64]
    keypoints: int  # how many keypoints the keyframe has, over all sections

    def write(self, out: Writer) -> None:
        """Append time, parent, pose and number of keypoints."""
        out.varint(self.t_ns)
        # Most parents are the keyframe before: their difference is 1.
        out.varint(0 if self.parent == NO_KEYFRAME else 1 + zigzag(self.keyframe - self.parent))
        write_pose(out, self.T_p_k)
        out.varint(self.keypoints)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        t_ns = source.varint()
        step = source.varint()
        parent = NO_KEYFRAME
        if step:
            parent = KeyframeId(key.id - unzigzag(step - 1))
            if not 0 <= parent <= MAX_KEYFRAME_ID:
                raise WireError(f"parent {parent} is no keyframe id")
        T_p_k = read_pose(source)
        return cls(KeyframeId(key.id), t_ns, parent, T_p_k, source.varint(MAX_KEYPOINTS))

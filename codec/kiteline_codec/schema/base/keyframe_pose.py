"""The refined pose of a keyframe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class KeyframePose(Record):
    """A keyframe's pose as the base refined it. T_m_k: (4,4) camera in the keyframe's submap."""

    KIND = 16
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION

    keyframe: KeyframeId
    T_m_k: NDArray[np.float64]

    def write(self, out: Writer) -> None:
        """Append the pose."""
        write_pose(out, self.T_m_k)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        return cls(KeyframeId(key.id), read_pose(source))

"""The rotation that makes a submap's z axis point up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.ids import SubmapId


@register
@dataclass(frozen=True, slots=True)
class GravityAlignment(Record):
    """Aligns with gravity a submap that began while the vehicle moved.

    T_l_m: (4,4) submap to its gravity-aligned frame.
    """

    KIND = 6
    ID = IdOf.SUBMAP
    PRIORITY = Priority.POSE

    submap: SubmapId
    T_l_m: NDArray[np.float64]

    def write(self, out: Writer) -> None:
        """Append the pose."""
        write_pose(out, self.T_l_m)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        return cls(SubmapId(key.id), read_pose(source))

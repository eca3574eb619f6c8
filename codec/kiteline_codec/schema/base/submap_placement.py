"""The placement of a submap in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.poses import read_pose, read_scale, write_pose, write_scale
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.geometry import sim3
from kiteline_core.ids import SubmapId


@register
@dataclass(frozen=True, slots=True)
class SubmapPlacement(Record):
    """A submap's pose and unit of length in the world. S_w_m: (4,4) similarity, rigid if both units are the same."""

    KIND = 21
    ID = IdOf.SUBMAP
    PRIORITY = Priority.POSE  # few bytes, and the whole error of a pose in the world
    IN_WORLD = True

    submap: SubmapId
    S_w_m: NDArray[np.float64]

    def write(self, out: Writer) -> None:
        """Append scale and pose."""
        write_scale(out, sim3.scale_of(self.S_w_m))
        write_pose(out, sim3.rigid(self.S_w_m))

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        scale = read_scale(source)
        return cls(SubmapId(key.id), sim3.of(scale, read_pose(source)))

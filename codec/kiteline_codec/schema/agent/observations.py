"""Observations of landmarks in a keyframe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.columns import Columns, read_landmarks, write_landmarks
from kiteline_codec.schema.record import MAX_PARTS, IdOf, Key, Priority, Record, register
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class Observations(Record):
    """Observations of landmarks of other keyframes. index: (n,) keypoints. uv: (n,2) px. inv_depth: (n,) 1/m from
    stereo, 0 where unknown. octave: (n,) pyramid level. point: (n,) LandmarkId.
    """

    KIND = 5
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.OBSERVATIONS
    PARTS = MAX_PARTS
    COLUMNS: ClassVar = Columns("index", "uv", "inv_depth", "octave", increasing=False)

    keyframe: KeyframeId
    part: int
    index: NDArray[np.uint16]
    uv: NDArray[np.float32]
    inv_depth: NDArray[np.float32]
    octave: NDArray[np.uint8]
    point: NDArray[np.int64]

    def write(self, out: Writer) -> None:
        """Append the rows and the landmark ids."""
        self.COLUMNS.write(out, self)
        write_landmarks(out, self.point)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        columns = cls.COLUMNS.read(source)
        return cls(KeyframeId(key.id), key.part, point=read_landmarks(source, len(columns["index"])), **columns)

"""Landmarks of a keyframe that were fused into others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.columns import Columns, read_landmarks, write_landmarks
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class FusedLandmarks(Record):
    """The landmark at keypoint index[i] of the keyframe is fused into the root landmark point[i]."""

    KIND = 18
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    COLUMNS: ClassVar = Columns("index")

    keyframe: KeyframeId
    index: NDArray[np.uint16]
    point: NDArray[np.int64]

    def write(self, out: Writer) -> None:
        """Append the rows and the root landmarks."""
        self.COLUMNS.write(out, self)
        write_landmarks(out, self.point)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        index = cls.COLUMNS.read(source)["index"]
        return cls(KeyframeId(key.id), index, read_landmarks(source, len(index)))

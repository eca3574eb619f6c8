"""Refined positions of a keyframe's landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.columns import Columns
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class RefinedLandmarks(Record):
    """Positions of a keyframe's landmarks as the base refined them. index: (n,) keypoints. inv_depth: (n,) 1/m. offset:
    (n,2) px added to the keypoint's pixel to give the bearing.
    """

    KIND = 17
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    COLUMNS: ClassVar = Columns("index", "inv_depth", "offset")

    keyframe: KeyframeId
    index: NDArray[np.uint16]
    inv_depth: NDArray[np.float32]
    offset: NDArray[np.float32]

    def write(self, out: Writer) -> None:
        """Append the rows."""
        self.COLUMNS.write(out, self)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        return cls(KeyframeId(key.id), **cls.COLUMNS.read(source))

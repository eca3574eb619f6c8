"""Observations that the base rejected as outliers."""

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
class RemovedObservations(Record):
    """Keypoints of a keyframe that no longer count, neither as an observation nor as a new landmark."""

    KIND = 19
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    COLUMNS: ClassVar = Columns("index")

    keyframe: KeyframeId
    index: NDArray[np.uint16]

    def write(self, out: Writer) -> None:
        """Append the rows."""
        self.COLUMNS.write(out, self)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        return cls(KeyframeId(key.id), **cls.COLUMNS.read(source))

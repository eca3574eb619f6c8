"""Landmarks, and perhaps a whole keyframe, that the base culled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.columns import Columns
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class CulledLandmarks(Record):
    """Landmarks of a keyframe that the base culled. keyframe_too: 1 if its observations are culled as well."""

    KIND = 20
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    COLUMNS: ClassVar = Columns("index")

    keyframe: KeyframeId
    index: NDArray[np.uint16]
    keyframe_too: int  # 0 or 1

    def write(self, out: Writer) -> None:
        """Append the rows and the flag."""
        self.COLUMNS.write(out, self)
        out.u8(self.keyframe_too)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        index = cls.COLUMNS.read(source)["index"]
        too = source.u8()
        if too > 1:
            raise WireError(f"keyframe_too is 0 or 1, found {too}")
        return cls(KeyframeId(key.id), index, too)

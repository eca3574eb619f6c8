"""The unit of length of a monocular agent's submap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.poses import read_scale, write_scale
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.ids import SubmapId


@register
@dataclass(frozen=True, slots=True)
class SubmapScale(Record):
    """A monocular submap's unit of length. metres: in one unit; 1 for a submap that began in metres. A submap without
    this record has an unknown unit.
    """

    KIND = 7
    ID = IdOf.SUBMAP
    PRIORITY = Priority.POSE

    submap: SubmapId
    metres: float

    def write(self, out: Writer) -> None:
        """Append the scale."""
        write_scale(out, self.metres)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        return cls(SubmapId(key.id), read_scale(source))

"""Observations of landmarks in a keyframe."""

from dataclasses import dataclass
from typing import ClassVar

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema.columns import Columns, Landmarks, write_landmarks
from kiteline_codec.schema.record import MAX_PARTS, IdOf, Priority, Record, register
from kiteline_core.arrays import F32, I64, U8, U16
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
    CODE = (COLUMNS, Landmarks("point"))

    keyframe: KeyframeId
    part: int
    index: U16
    uv: F32
    inv_depth: F32
    octave: U8
    point: I64

    def write_rows(self, out: Writer, codes: I64, rows: I64) -> None:
        """Append all but the key of some rows. codes: (5,n) of the columns of all."""
        self.COLUMNS.write_codes(out, codes.take(rows, 1))
        write_landmarks(out, self.point.take(rows))

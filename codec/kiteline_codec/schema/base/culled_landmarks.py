"""Landmarks, and perhaps a whole keyframe, that the base culled."""

from dataclasses import dataclass
from typing import ClassVar

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema.columns import Columns
from kiteline_codec.schema.record import Field, IdOf, Priority, Record, read_flag, register
from kiteline_core.arrays import U16
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class CulledLandmarks(Record):
    """Landmarks of a keyframe that the base culled. keyframe_too: 1 if its observations are culled as well."""

    KIND = 20
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    COLUMNS: ClassVar = Columns("index")
    CODE = (COLUMNS, Field("keyframe_too", Writer.u8, read_flag))

    keyframe: KeyframeId
    index: U16
    keyframe_too: int  # 0 or 1

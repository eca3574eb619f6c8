"""Refined positions of a keyframe's landmarks."""

from dataclasses import dataclass
from typing import ClassVar

from kiteline_codec.schema.batches import read_batch, write_batch
from kiteline_codec.schema.columns import Columns
from kiteline_codec.schema.record import Field, IdOf, Priority, Record, register
from kiteline_core.arrays import F32, U16
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class RefinedLandmarks(Record):
    """Positions of a keyframe's landmarks as the base refined them. index: (n,) keypoints. inv_depth: (n,) 1/m. offset:
    (n,2) px added to the keypoint's pixel to give the bearing. batch: see CorrectionBatch.
    """

    KIND = 17
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    COLUMNS: ClassVar = Columns("index", "inv_depth", "offset")
    CODE = (COLUMNS, Field("batch", write_batch, read_batch))

    keyframe: KeyframeId
    index: U16
    inv_depth: F32
    offset: F32
    batch: int = 0

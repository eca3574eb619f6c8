"""Observations that the base rejected as outliers."""

from dataclasses import dataclass

from kiteline_codec.schema.columns import Columns
from kiteline_codec.schema.record import IdOf, Priority, Record, register
from kiteline_core.arrays import U16
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class RemovedObservations(Record):
    """Keypoints of a keyframe that no longer count, neither as an observation nor as a new landmark."""

    KIND = 19
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    CODE = (Columns("index"),)

    keyframe: KeyframeId
    index: U16

"""Landmarks of a keyframe that were fused into others."""

from dataclasses import dataclass

from kiteline_codec.schema.columns import Columns, Landmarks
from kiteline_codec.schema.record import IdOf, Priority, Record, register
from kiteline_core.arrays import I64, U16
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class FusedLandmarks(Record):
    """The landmark at keypoint index[i] of the keyframe is fused into the root landmark point[i]."""

    KIND = 18
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    CODE = (Columns("index"), Landmarks("point"))

    keyframe: KeyframeId
    index: U16
    point: I64

"""Landmarks of a keyframe that were fused into others."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.schema.columns import Columns, Landmarks
from kiteline_codec.schema.record import IdOf, Priority, Record, register
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
    index: NDArray[np.uint16]
    point: NDArray[np.int64]

"""Observations that the base rejected as outliers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.schema.columns import Columns
from kiteline_codec.schema.record import IdOf, Priority, Record, register
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
    index: NDArray[np.uint16]

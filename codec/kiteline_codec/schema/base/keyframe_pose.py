"""The refined pose of a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.schema.batches import Batch
from kiteline_codec.schema.poses import Pose
from kiteline_codec.schema.record import IdOf, Priority, Record, register
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class KeyframePose(Record):
    """A keyframe's pose as the base refined it. T_m_k: (4,4) camera in its submap. batch: see CorrectionBatch."""

    KIND = 16
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    CODE = (Pose("T_m_k"), Batch())

    keyframe: KeyframeId
    T_m_k: NDArray[np.float64]
    batch: int = 0

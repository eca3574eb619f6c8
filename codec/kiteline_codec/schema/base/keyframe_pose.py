"""The refined pose of a keyframe."""

from dataclasses import dataclass

from kiteline_codec.schema.batches import read_batch, write_batch
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import Field, IdOf, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.ids import KeyframeId


@register
@dataclass(frozen=True, slots=True)
class KeyframePose(Record):
    """A keyframe's pose as the base refined it. T_m_k: (4,4) camera in its submap. batch: see CorrectionBatch."""

    KIND = 16
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.CORRECTION
    CODE = (Field("T_m_k", write_pose, read_pose), Field("batch", write_batch, read_batch))

    keyframe: KeyframeId
    T_m_k: F64
    batch: int = 0

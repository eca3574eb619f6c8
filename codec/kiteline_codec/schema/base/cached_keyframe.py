"""A keyframe that the base sends down into an agent's map cache."""

from dataclasses import dataclass

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import MAX_SUBMAP_ID, Field, IdOf, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.ids import KeyframeId, SubmapId


@register
@dataclass(frozen=True, slots=True)
class CachedKeyframe(Record):
    """A keyframe of another agent, or one that its agent evicted. T_m_k: (4,4) camera in the receiver's `submap`."""

    KIND = 23
    ID = IdOf.CACHED_KEYFRAME
    PRIORITY = Priority.REST
    CODE = (
        Field("submap", Writer.varint, lambda source: SubmapId(source.varint(MAX_SUBMAP_ID))),
        Field("T_m_k", write_pose, read_pose),
    )

    keyframe: KeyframeId
    submap: SubmapId
    T_m_k: F64

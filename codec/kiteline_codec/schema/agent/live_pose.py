"""The newest pose of an agent."""

from dataclasses import dataclass
from typing import Self

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import MAX_KEYFRAME_ID, IdOf, Key, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.ids import AgentId, KeyframeId


@register
@dataclass(frozen=True, slots=True)
class LivePose(Record):
    """An agent's newest pose, relative to a keyframe. T_k_c: (4,4) camera in the keyframe. quality: -1, 0, 1..100."""

    KIND = 2
    ID = IdOf.AGENT
    PRIORITY = Priority.POSE

    agent: AgentId
    t_ns: int
    keyframe: KeyframeId
    T_k_c: F64
    quality: int

    def write(self, out: Writer) -> None:
        """Append time, keyframe, pose and quality."""
        out.varint(self.t_ns)
        out.varint(self.keyframe + 1)
        write_pose(out, self.T_k_c)
        out.signed(self.quality)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        t_ns = source.varint()
        keyframe = KeyframeId(source.varint(MAX_KEYFRAME_ID + 1) - 1)
        T_k_c = read_pose(source)
        quality = source.signed(100)
        if quality < -1:
            raise WireError(f"quality is -1, 0 or 1..100, found {quality}")
        return cls(AgentId(key.id), t_ns, keyframe, T_k_c, quality)

"""The placement of a submap in the world."""

from dataclasses import dataclass
from typing import Self

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.batches import read_batch, write_batch
from kiteline_codec.schema.poses import read_pose, read_scale, write_pose, write_scale
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.geometry import sim3
from kiteline_core.ids import SubmapId


@register
@dataclass(frozen=True, slots=True)
class SubmapPlacement(Record):
    """A submap's pose and unit of length in the world.

    S_w_m: (4,4) similarity, rigid if both units are the same. recognised: the submap's pose rests on a merge with
    another submap, not on the odometry of its agent alone. scale_sigma: relative standard deviation of lengths in w as
    accelerations tell them; 0 where they tell nothing. batch: see CorrectionBatch.
    """

    KIND = 21
    ID = IdOf.SUBMAP
    PRIORITY = Priority.POSE  # few bytes, and the whole error of a pose in the world

    submap: SubmapId
    S_w_m: F64
    recognised: bool = False
    batch: int = 0
    scale_sigma: float = 0.0

    def write(self, out: Writer) -> None:
        """Append scale, pose and, unless all three are 0, a byte of recognised and deviation, and the batch."""
        write_scale(out, sim3.scale_of(self.S_w_m))
        write_pose(out, sim3.rigid(self.S_w_m))
        flags = int(self.recognised) | quantise.deviation_code(self.scale_sigma) << 1
        if flags or self.batch:
            out.u8(flags)
            write_batch(out, self.batch)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        scale = read_scale(source)
        S_w_m = sim3.of(scale, read_pose(source))
        more = source.left > 0
        flags = source.u8() if more else 0
        batch = read_batch(source)
        if more and not (flags or batch):
            raise WireError("a byte of 0 behind a placement is for one whose number of a batch follows")
        return cls(SubmapId(key.id), S_w_m, bool(flags & 1), batch, quantise.deviation(flags >> 1))

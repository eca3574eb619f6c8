"""Images of a keyframe, or of a frame after it, of which the base makes a column scan."""

from dataclasses import dataclass
from typing import Self

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.poses import read_direction, read_pose, write_direction, write_pose
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.ids import KeyframeId

_MOST_STRETCHES = 1 << 32


@register
@dataclass(frozen=True, slots=True)
class ScanImages(Record):
    """A rectified pair at the size of disparity images, and what else a scan of it needs.

    part, T_k_s: as in `KeyframeScan`. T_o_c: (4,4) of its camera in the odometry frame; stretch: which one, as it
    begins anew where the motion was lost. up_c: (3,) unit vector against gravity in the camera. images: their code
    (`kiteline_core.ground.image_codes`). The agent removes the record once it has arrived.
    """

    KIND = 12
    ID = IdOf.PASSING_KEYFRAME
    PRIORITY = Priority.GRID
    PARTS = 16
    FIRST_PARTS = PARTS
    MOST_BYTES = 1 << 18

    keyframe: KeyframeId
    T_o_c: F64
    stretch: int
    up_c: F64
    images: bytes
    part: int = 0
    T_k_s: F64 | None = None

    def write(self, out: Writer) -> None:
        """Append poses, direction of gravity and images. Raises ValueError for values that have no code."""
        if (self.T_k_s is None) != (self.part == 0):
            raise ValueError("images of a frame after its keyframe have a pose, and only they")
        if not 0 < len(self.images) <= self.MOST_BYTES or not 0 <= self.stretch < _MOST_STRETCHES:
            raise ValueError(f"found {len(self.images)} bytes of images, expected up to {self.MOST_BYTES}")
        write_pose(out, self.T_o_c)
        out.varint(self.stretch)
        write_direction(out, self.up_c)
        if self.T_k_s is not None:
            write_pose(out, self.T_k_s)
        out.raw(self.images)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code. Raises WireError."""
        T_o_c, stretch = read_pose(source), source.varint(_MOST_STRETCHES - 1)
        up_c = read_direction(source)
        T_k_s = read_pose(source) if key.part else None
        images = source.raw(source.left)
        if not 0 < len(images) <= cls.MOST_BYTES:
            raise WireError(f"found {len(images)} bytes of images, expected up to {cls.MOST_BYTES}")
        return cls(KeyframeId(key.id), T_o_c, stretch, up_c, images, key.part, T_k_s)

"""The header of a keyframe: time, parent, pose relative to the parent, and where gravity points."""

from dataclasses import dataclass
from typing import Self

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, WireError, Writer, unzigzag, zigzag
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import MAX_KEYFRAME_ID, IdOf, Key, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.ids import MAX_KEYPOINTS, NO_KEYFRAME, KeyframeId


@register
@dataclass(frozen=True, slots=True)
class KeyframeHeader(Record):
    """A keyframe's header. T_p_k: (4,4) this keyframe's camera in its parent's; for the first of a submap
    (parent NO_KEYFRAME) in the submap frame m, whose z points up. up: (3,) unit vector against gravity in this
    keyframe's camera, as the IMU and the tracking up to here know it; None without. up_rad: its standard deviation
    about each axis across it.
    """

    KIND = 3
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.KEYFRAME
    PREDICTS = True

    keyframe: KeyframeId
    t_ns: int
    parent: KeyframeId
    T_p_k: F64
    keypoints: int  # how many keypoints the keyframe has, over all sections
    up: F64 | None = None
    up_rad: float = 0.0

    def write(self, out: Writer) -> None:
        """Append time, parent, pose, number of keypoints and, if it is known, the direction of gravity."""
        out.varint(self.t_ns)
        # Most parents are the keyframe before: their difference is 1.
        out.varint(0 if self.parent == NO_KEYFRAME else 1 + zigzag(self.keyframe - self.parent))
        write_pose(out, self.T_p_k)
        out.varint(self.keypoints)
        if self.up is not None:
            half, a, b = quantise.direction_codes(self.up)
            code = quantise.deviation_code(self.up_rad)
            if code == 0:
                raise ValueError(f"found a deviation of {self.up_rad} rad, expected one above 0")
            out.u8(quantise.DEVIATION_CODES * half + code)
            out.signed(a)
            out.signed(b)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        t_ns = source.varint()
        step = source.varint()
        parent = NO_KEYFRAME
        if step:
            parent = KeyframeId(key.id - unzigzag(step - 1))
            if not 0 <= parent <= MAX_KEYFRAME_ID:
                raise WireError(f"parent {parent} is no keyframe id")
        T_p_k, keypoints = read_pose(source), source.varint(MAX_KEYPOINTS)
        if not source.left:
            return cls(KeyframeId(key.id), t_ns, parent, T_p_k, keypoints)
        half, code = divmod(source.u8(), quantise.DEVIATION_CODES)
        a, b = (source.signed(quantise.DIRECTION_STEPS) for _ in range(2))
        if code == 0:
            raise WireError("a direction of gravity has a deviation above 0")
        try:
            up = quantise.direction(half, a, b)
        except ValueError as e:
            raise WireError(str(e)) from None
        return cls(KeyframeId(key.id), t_ns, parent, T_p_k, keypoints, up, quantise.deviation(code))

"""Landmarks with descriptors: what new landmarks and landmarks of the map cache have in common."""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.columns import Columns
from kiteline_codec.schema.record import MAX_PARTS, Key, Record
from kiteline_core.arrays import F32, I64, U8, U16
from kiteline_core.ids import KeyframeId
from kiteline_core.imaging import descriptors
from kiteline_core.imaging.descriptors import DESCRIPTOR_BYTES, NARROW_BYTES


@dataclass(frozen=True, slots=True)
class DescribedLandmarks(Record):
    """Landmarks of a keyframe, best first over the parts. index: (n,) keypoints, increasing within a part. uv: (n,2)
    px. inv_depth: (n,) 1/m. octave: (n,) pyramid level, factor 2 per level. angle: (n,) in 1/256 turns. descriptor:
    (n,32).
    """

    PARTS = MAX_PARTS
    COLUMNS: ClassVar = Columns("index", "uv", "inv_depth", "octave", "angle")

    keyframe: KeyframeId
    part: int
    index: U16
    uv: F32
    inv_depth: F32
    octave: U8
    angle: U8
    descriptor: U8

    def write(self, out: Writer) -> None:
        """Append the rows and the descriptors in the fewest bytes: 0, 16 or 32 a row."""
        descriptor = np.ascontiguousarray(self.descriptor, np.uint8)
        if descriptor.shape != (len(self.index), DESCRIPTOR_BYTES):
            raise ValueError(f"descriptors are {descriptor.shape}, expected {(len(self.index), DESCRIPTOR_BYTES)}")
        self.COLUMNS.write(out, self)
        _write_descriptors(out, descriptor)

    def write_rows(self, out: Writer, codes: I64, rows: I64) -> None:
        """The same of some rows. codes: (6,n) of the columns of all."""
        self.COLUMNS.write_codes(out, codes.take(rows, 1))
        _write_descriptors(out, self.descriptor.take(rows, 0))

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        columns = cls.COLUMNS.read(source)
        n = len(columns["index"])
        size = {NARROW_BYTES * n: NARROW_BYTES, 0: 0}.get(source.left, DESCRIPTOR_BYTES)
        raw = np.frombuffer(source.raw(size * n), np.uint8).reshape(n, size)
        if size < DESCRIPTOR_BYTES:
            raw = descriptors.unpacked(raw) if size else np.zeros((n, DESCRIPTOR_BYTES), np.uint8)
        if n and size and (not raw.any() or (size == DESCRIPTOR_BYTES and descriptors.all_narrow(raw))):
            raise WireError("descriptors are written in the fewest bytes that hold them")
        return cls(KeyframeId(key.id), key.part, descriptor=raw, **columns)


def _write_descriptors(out: Writer, descriptor: U8) -> None:
    if descriptor.any():
        narrow = descriptors.all_narrow(descriptor)
        out.raw((descriptors.packed(descriptor) if narrow else descriptor).tobytes())

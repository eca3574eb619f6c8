"""Residual codes of new landmarks, which need no prediction, and of refined landmarks, predicted from them."""

from collections.abc import Iterable

import numpy as np

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.residuals import prediction_kernels as kernels
from kiteline_codec.residuals.predictors import Held, Predictors
from kiteline_codec.schema import Key, NewLandmarks, RefinedLandmarks
from kiteline_codec.schema.batches import MAX_BATCH, read_batch, write_batch
from kiteline_core.arrays import I32, I64
from kiteline_core.ids import MAX_KEYPOINTS

_DESCRIPTOR_SIZES = (0, 16, 32)
_MAX_MASK = (1 << 16) - 1
CHECKSUM_BYTES = 4  # at the end of each residual code


class NewLandmarkResiduals:
    """New landmarks: columns in as few bits as their spread needs."""

    def compress(self, out: Writer, key: Key, code: bytes, held: Held, own: Held) -> list[int]:
        """Append the residual code. Returns the versions used: none. Raises ValueError or WireError."""
        source = Reader(code)
        values = NewLandmarks.COLUMNS.read_codes(source)
        n = values.shape[1]
        size = source.left // n if n else 0
        if size not in _DESCRIPTOR_SIZES:
            raise ValueError(f"descriptors take {size} bytes")
        out.varint(n << 2 | _DESCRIPTOR_SIZES.index(size))
        values[0] = _gaps(values[0])
        out.residual_columns(values)
        out.raw(source.raw(size * n))
        source.end()
        return []

    def expand(self, out: Writer, key: Key, source: Reader, held: Held) -> list[int]:
        """Append the code. Returns the versions used: none. Raises WireError."""
        head = source.varint(MAX_KEYPOINTS << 2 | 2)
        if head & 3 >= len(_DESCRIPTOR_SIZES):
            raise WireError("descriptors of an unknown size")
        n = head >> 2
        values = source.residual_columns(6, n)
        values[0] = np.cumsum(values[0] + 1) - 1
        out.varint(n)
        out.columns(values)
        out.raw(source.raw(_DESCRIPTOR_SIZES[head & 3] * n))
        return []


class RefinedLandmarkResiduals:
    """Refined landmarks: inverse depths as differences from those that the agent measured."""

    def __init__(self, predictors: Predictors) -> None:
        self._predictors = predictors

    def compress(self, out: Writer, key: Key, code: bytes, held: Held, own: Held) -> list[int]:
        """Append the residual code. Returns the versions used. Raises ValueError or WireError."""
        source = Reader(code)
        values = RefinedLandmarks.COLUMNS.read_codes(source)
        batch = read_batch(source)
        source.end()
        versions, landmarks = self._predictors.landmarks(key.id, held)
        out.varint(values.shape[1])
        out.varint(sum(1 << part for part in versions))
        measured = _measured_depths(landmarks, versions, values[0])
        out.residual_columns(np.stack([_gaps(values[0]), values[1] - measured, values[2], values[3]]))
        write_batch(out, batch)
        return [versions[part] for part in sorted(versions)]

    def expand(self, out: Writer, key: Key, source: Reader, held: Held) -> list[int]:
        """Append the code. Returns the versions used. Raises WireError."""
        n = source.varint(MAX_KEYPOINTS)
        mask = source.varint(_MAX_MASK)
        values = source.residual_columns(4, n)
        values[0] = np.cumsum(values[0] + 1) - 1
        versions, landmarks = self._predictors.landmarks(key.id, held)
        parts = [part for part in range(mask.bit_length()) if mask >> part & 1]
        if not all(part in versions for part in parts):
            raise WireError("a residual code is predicted from landmarks that are not held")
        if n and (values[0].min() < 0 or values[0].max() >= MAX_KEYPOINTS):
            raise WireError("a keypoint is out of range")
        values[1] += _measured_depths(landmarks, parts, values[0])
        out.varint(n)
        out.columns(values)
        if source.left > CHECKSUM_BYTES:
            out.varint(source.varint(MAX_BATCH))
        return [versions[part] for part in parts]


def _gaps(index: I64) -> I64:
    """How many numbers are left out before each of increasing ones."""
    gaps = index.copy()
    gaps[1:] -= index[:-1] + 1
    return gaps


def _measured_depths(landmarks: I32, parts: Iterable[int], index: I64) -> I64:
    """Codes (n,) of inverse depths as the agent measured them, 0 where none of the parts has the keypoint."""
    measured: I64 = np.zeros((4, len(index)), np.int64)
    kernels.select(landmarks, index, sum(1 << part for part in parts), 0, measured)
    return np.asarray(measured[2])

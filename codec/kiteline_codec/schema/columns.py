"""Arrays of a record as columns of integers, and landmark ids as a table of keyframes. See SPEC.md, "Rows"."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.coding.packing_kernels import first_fault
from kiteline_codec.schema.record import MAX_KEYFRAME_ID
from kiteline_core.arrays import I64
from kiteline_core.ids import KEYPOINT_BITS, MAX_KEYPOINTS

_LEAST = np.zeros(2, np.int64)  # of places in a table, and keypoints


@dataclass(frozen=True, slots=True)
class _Field:
    """How an array becomes columns of integers in [low, high], and how columns become the array."""

    columns: int
    low: int
    high: int
    codes: Callable[[Any], I64]
    values: Callable[[I64], Any]


def _integers(dtype: Any, high: int) -> _Field:
    return _Field(1, 0, high, lambda a: np.asarray(a).astype(np.int64), lambda c: c[0].astype(dtype))


_FIELDS = {
    "index": _integers(np.uint16, MAX_KEYPOINTS - 1),
    "uv": _Field(2, 0, quantise.PIXEL_CODES - 1, quantise.pixel_codes, quantise.pixels),
    "inv_depth": _Field(
        1, 0, quantise.DEPTH_CODES - 1, quantise.inverse_depth_codes, lambda c: quantise.inverse_depths(c[0])
    ),
    "octave": _integers(np.uint8, 15),
    "angle": _integers(np.uint8, 255),
    "offset": _Field(
        2, 1 - quantise.OFFSET_CODES, quantise.OFFSET_CODES - 1, quantise.offset_codes, quantise.offsets
    ),
}  # fmt: skip


class Columns:
    """The columns of one kind of record, `index` first. increasing: whether indices increase from row to row."""

    def __init__(self, *names: str, increasing: bool = True) -> None:
        self._fields = [(name, _FIELDS[name]) for name in names]
        self._increasing = increasing
        self._column_names = [name for name, field in self._fields for _ in range(field.columns)]
        self._low = np.array([_FIELDS[name].low for name in self._column_names], np.int64)
        self._high = np.array([_FIELDS[name].high for name in self._column_names], np.int64)

    def codes(self, record: Any) -> I64:
        """The codes (columns, n) of a record, unchecked. Raises ValueError for values that have no code."""
        codes = np.empty((len(self._column_names), len(record.index)), np.int64)
        at = 0
        for name, field in self._fields:
            codes[at : at + field.columns] = field.codes(getattr(record, name))
            at += field.columns
        return codes

    def write(self, out: Writer, record: Any) -> None:
        """Append the number of rows and the columns. Raises ValueError for values that have no code."""
        self.write_codes(out, self.codes(record))

    def write_codes(self, out: Writer, codes: I64) -> None:
        """Append the number of rows and the columns (columns, n). Raises ValueError for invalid ones."""
        n = codes.shape[1]
        if n > MAX_KEYPOINTS:
            raise ValueError(f"found {n} keypoints, expected at most {MAX_KEYPOINTS}")
        if fault := self._fault(codes):
            raise ValueError(fault)
        out.varint(n)
        out.columns(codes)

    def read_codes(self, source: Reader) -> I64:
        """The codes (columns, n), unchecked. Raises WireError."""
        return source.columns(len(self._column_names), source.varint(MAX_KEYPOINTS))

    def read(self, source: Reader, _values: dict[str, Any] | None = None) -> dict[str, Any]:
        """The arrays by name. Raises WireError."""
        codes = self.read_codes(source)
        if fault := self._fault(codes):
            raise WireError(fault)
        out = {}
        at = 0
        for name, field in self._fields:
            out[name] = field.values(codes[at : at + field.columns])
            at += field.columns
        return out

    def _fault(self, codes: I64) -> str:
        """The reason why codes (columns, n) are invalid; "" when they are valid."""
        i = first_fault(codes, self._low, self._high, self._increasing)
        if i < 0:
            return ""
        if i == len(codes):
            return "indices must increase"
        found = f"{codes[i].min()}..{codes[i].max()}"
        return f"{self._column_names[i]} is {found}, expected {self._low[i]}..{self._high[i]}"


def write_landmarks(out: Writer, landmark: I64) -> None:
    """Append landmark ids (n,). Raises ValueError."""
    landmark = np.asarray(landmark, np.int64)
    if not landmark.size:
        return
    if landmark.min() < 0:
        raise ValueError("a landmark id is not negative")
    keyframes, place = np.unique(landmark >> KEYPOINT_BITS, return_inverse=True)
    place = place.reshape(-1).astype(np.int64)
    write_landmark_table(out, keyframes.tolist(), place, landmark & (MAX_KEYPOINTS - 1))


def write_landmark_table(out: Writer, keyframes: Sequence[int], place: I64, keypoint: I64) -> None:
    """Append landmarks: a table of their keyframes, increasing, and two columns (n,): place in the table, keypoint."""
    if not len(place):
        return
    out.varint(len(keyframes))
    last = 0
    for keyframe in keyframes:
        out.varint(keyframe - last)
        last = keyframe
    out.columns(np.stack([place, keypoint]))


def read_landmark_table(source: Reader, n: int) -> tuple[list[int], I64, I64]:
    """Keyframes, increasing; of each of n landmarks the place in that table and the keypoint. Raises WireError."""
    if not n:
        return [], np.zeros(0, np.int64), np.zeros(0, np.int64)
    keyframes: list[int] = []
    last = 0
    for i in range(source.varint(n)):
        step = source.varint(MAX_KEYFRAME_ID)
        last += step
        if last > MAX_KEYFRAME_ID or (i and not step):
            raise WireError("keyframes of landmarks must increase and fit an id")
        keyframes.append(last)
    table = source.columns(2, n)
    if first_fault(table, _LEAST, np.array([len(keyframes) - 1, MAX_KEYPOINTS - 1], np.int64), False) >= 0:
        raise WireError("a landmark id is out of range")
    return keyframes, table[0], table[1]


def read_landmarks(source: Reader, n: int) -> I64:
    """Landmark ids (n,). Raises WireError."""
    keyframes, place, keypoint = read_landmark_table(source, n)
    return np.asarray(np.array(keyframes, np.int64)[place] << KEYPOINT_BITS | keypoint, np.int64)


@dataclass(frozen=True, slots=True)
class Landmarks:
    """The code of a field of landmark ids (n,), n as the field `index` has."""

    field: str

    def write(self, out: Writer, record: Any) -> None:
        """Append the ids. Raises ValueError."""
        write_landmarks(out, getattr(record, self.field))

    def read(self, source: Reader, values: dict[str, Any]) -> dict[str, Any]:
        """The ids by name. Raises WireError."""
        return {self.field: read_landmarks(source, len(values["index"]))}

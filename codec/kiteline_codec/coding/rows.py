"""The keypoints of a record as columns of integers, and point ids as a table of keyframes. See SPEC.md, "Rows"."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.coding.packing_kernels import first_outside
from kiteline_codec.schema import Kind, WireError
from kiteline_core.ids import KEYPOINT_BITS, MAX_KEYPOINTS

I64 = NDArray[np.int64]

MAX_KEYFRAME_ID = (1 << 52) - 1  # as laid out in kiteline_core.ids


@dataclass(frozen=True, slots=True)
class _Field:
    """How one array of a record becomes columns of integers. Codes lie in [low, high]."""

    columns: int
    low: int
    high: int
    codes: Callable[[Any], I64]
    values: Callable[[I64], Any]


def _plain(dtype: Any, high: int) -> _Field:
    return _Field(1, 0, high, lambda a: np.asarray(a).astype(np.int64), lambda c: c[0].astype(dtype))


_FIELDS = {
    "index": _plain(np.uint16, MAX_KEYPOINTS - 1),
    "uv": _Field(2, 0, quantise.PIXEL_CODES - 1, quantise.pixel_codes, quantise.pixels),
    "inv_depth": _Field(
        1, 0, quantise.DEPTH_CODES - 1, quantise.inverse_depth_codes, lambda c: quantise.inverse_depths(c[0])
    ),
    "octave": _plain(np.uint8, 15),
    "angle": _plain(np.uint8, 255),
    "offset": _Field(
        2, 1 - quantise.OFFSET_CODES, quantise.OFFSET_CODES - 1, quantise.offset_codes, quantise.offsets
    ),
}  # fmt: skip

_COLUMNS: dict[Kind, tuple[str, ...]] = {
    Kind.NEW_LANDMARKS: ("index", "uv", "inv_depth", "octave", "angle"),
    Kind.OBSERVATIONS: ("index", "uv", "inv_depth", "octave"),
    Kind.REFINED_LANDMARKS: ("index", "inv_depth", "offset"),
    Kind.FUSED_LANDMARKS: ("index",),
    Kind.REMOVED_OBSERVATIONS: ("index",),
    Kind.CULLED_LANDMARKS: ("index",),
    Kind.CACHED_LANDMARKS: ("index", "uv", "inv_depth", "octave", "angle"),
}


_LIMITS = {
    kind: tuple(
        np.array([getattr(_FIELDS[name], end) for name in names for _ in range(_FIELDS[name].columns)], np.int64)
        for end in ("low", "high")
    )
    for kind, names in _COLUMNS.items()
}


def _out_of_range(kind: Kind, values: I64) -> str:
    """What is wrong with the codes (columns, n) of a kind, "" when nothing is."""
    low, high = _LIMITS[kind]
    i = first_outside(values, low, high)
    if i < 0:
        return ""
    names = [name for name in _COLUMNS[kind] for _ in range(_FIELDS[name].columns)]
    return f"{names[i]} is {values[i].min()}..{values[i].max()}, expected {low[i]}..{high[i]}"


def write_columns(out: Writer, kind: Kind, record: Any) -> None:
    """The number of rows and the columns of a record's kind. Raises ValueError for values that have no code."""
    n = len(record.index)
    if n > MAX_KEYPOINTS:
        raise ValueError(f"found {n} keypoints, expected at most {MAX_KEYPOINTS}")
    out.varint(n)
    names = _COLUMNS[kind]
    values = np.empty((sum(_FIELDS[name].columns for name in names), n), np.int64)
    row = 0
    for name in names:
        field = _FIELDS[name]
        codes = field.codes(getattr(record, name))
        values[row : row + field.columns] = codes
        row += field.columns
    if wrong := _out_of_range(kind, values):
        raise ValueError(wrong)
    if kind is not Kind.OBSERVATIONS and n > 1 and np.diff(values[0]).min() <= 0:
        raise ValueError("indices must increase")
    out.columns(values)


def read_codes(source: Reader, kind: Kind) -> I64:
    """The codes (columns, n) of a record's kind, unchecked. Raises WireError."""
    n = source.varint(MAX_KEYPOINTS)
    return source.columns(sum(_FIELDS[name].columns for name in _COLUMNS[kind]), n)


def read_columns(source: Reader, kind: Kind) -> tuple[int, dict[str, Any]]:
    """The number of rows, and the arrays by name. Raises WireError."""
    names = _COLUMNS[kind]
    values = read_codes(source, kind)
    n = values.shape[1]
    if wrong := _out_of_range(kind, values):
        raise WireError(wrong)
    out = {}
    row = 0
    for name in names:
        field = _FIELDS[name]
        codes = values[row : row + field.columns]
        out[name] = field.values(codes)
        row += field.columns
    if kind is not Kind.OBSERVATIONS and n > 1 and np.diff(values[0]).min() <= 0:
        raise WireError("indices must increase")
    return n, out


def write_points(out: Writer, point: I64) -> None:
    """Point ids: a table of the keyframes of birth, increasing, then two columns: place in the table and keypoint."""
    point = np.asarray(point, np.int64)
    if not point.size:
        return
    if point.min() < 0:
        raise ValueError("a point id is not negative")
    table, place = np.unique(point >> KEYPOINT_BITS, return_inverse=True)
    out.varint(len(table))
    last = 0
    for keyframe in table.tolist():
        out.varint(keyframe - last)
        last = keyframe
    out.columns(np.stack([place.reshape(-1).astype(np.int64), point & (MAX_KEYPOINTS - 1)]))


def read_points(source: Reader, n: int) -> I64:
    """Point ids (n,). Raises WireError."""
    if not n:
        return np.zeros(0, np.int64)
    size = source.varint(n)
    table = np.zeros(size, np.int64)
    last = 0
    for i in range(size):
        step = source.varint(MAX_KEYFRAME_ID)
        last += step
        if last > MAX_KEYFRAME_ID or (i and not step):
            raise WireError("keyframes of birth must increase and fit an id")
        table[i] = last
    place, keypoint = source.columns(2, n)
    if not size or place.min() < 0 or place.max() >= size or keypoint.min() < 0 or keypoint.max() >= MAX_KEYPOINTS:
        raise WireError("a point id is out of range")
    return np.asarray(table[place] << KEYPOINT_BITS | keypoint, np.int64)

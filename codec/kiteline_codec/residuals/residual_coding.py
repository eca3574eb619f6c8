"""Shorter forms of codes on the wire. State stays the plain code; see SPEC.md, "Tight forms".

Births lose the bits that their spread does not need. Sightings are written as differences from where the agent's own
earlier values foresee them, depths as differences from what the agent saw: values that the peer is known to hold. A
form ends with a checksum of the plain code and of the versions used; a receiver that holds others refuses it, and the
sender then sends the code itself.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from struct import pack
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.residuals import prediction_kernels as kernels
from kiteline_codec.residuals.predictors import Held, References, parts_at
from kiteline_codec.schema import (
    Key,
    KeyframeHeader,
    NewLandmarks,
    Observations,
    RefinedLandmarks,
    WireError,
    messages,
)
from kiteline_codec.schema.columns import read_landmark_table, write_landmark_table
from kiteline_codec.schema.record import MAX_KEYFRAME_ID
from kiteline_core.ids import KEYPOINT_BITS, MAX_KEYPOINTS, NO_KEYFRAME, KeyframeId

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

TIGHT_KINDS = frozenset({NewLandmarks.KIND, Observations.KIND, RefinedLandmarks.KIND})
_CRC_BYTES = 4
_MAX_SHIFT = 8
_DESCRIPTOR_SIZES = (0, 16, 32)
_UNBORN: tuple[dict[int, int], I32] = ({}, np.empty((5, 0), np.int32))  # a keyframe whose births are not used
_REMEMBERED = 64  # forms of births that are kept: they build upon nothing, and are asked for until they fit a packet


class Tightener:
    """Makes and reads tight forms; remembers what it decoded for them."""

    def __init__(self) -> None:
        self._references = References()
        self._births: OrderedDict[Key, tuple[bytes, bytes | None]] = OrderedDict()  # codes and their forms

    def shrink(self, key: Key, code: bytes, held: Held, own: Held) -> bytes | None:
        """A shorter form of a code, for a peer that holds what `held` gives; None where there is none.

        own: values of this side, whether the peer holds them or not.
        """
        if key.kind not in TIGHT_KINDS:
            return None
        if key.kind == NewLandmarks.KIND:
            return self._shrink_births(key, code)
        out = Writer()
        try:
            if key.kind == Observations.KIND:
                versions = self._shrink_sightings(out, key, code, held, own)
            else:
                versions = self._shrink_depths(out, key, code, held)
        except (ValueError, WireError):  # a code of another schema, or numbers beyond the form: it goes as it is
            return None
        data = out.bytes() + _checksum(code, versions)
        return data if len(data) < len(code) else None

    def grow(self, key: Key, data: bytes, held: Held) -> bytes:
        """The code of a tight form. Raises WireError, also when the values that it builds upon are not held."""
        source, out = Reader(data), Writer()
        if key.kind == NewLandmarks.KIND:
            versions = _grow_births(out, source)
        elif key.kind == Observations.KIND:
            versions = self._grow_sightings(out, key, source, held)
        elif key.kind == RefinedLandmarks.KIND:
            versions = self._grow_depths(out, key, source, held)
        else:
            raise WireError(f"kind {key.kind} has no tight form")
        checksum, code = source.raw(_CRC_BYTES), out.bytes()
        source.end()
        if _checksum(code, versions) != checksum:
            raise WireError("a tight form was made with other values than are held")
        return code

    def _shrink_births(self, key: Key, code: bytes) -> bytes | None:
        made = self._births.get(key)
        if made is not None and made[0] == code:
            return made[1]
        out = Writer()
        form = None
        try:
            _shrink_births(out, code)
            form = out.bytes() + _checksum(code, ())
        except (ValueError, WireError):
            pass
        form = form if form is not None and len(form) < len(code) else None
        self._births[key] = code, form
        if len(self._births) > _REMEMBERED:
            self._births.popitem(last=False)
        return form

    # ---- sightings

    def _shrink_sightings(self, out: Writer, key: Key, code: bytes, held: Held, own: Held) -> list[int]:
        source = Reader(code)
        values = Observations.COLUMNS.read_codes(source)
        n = values.shape[1]
        table, place, keypoint = read_landmark_table(source, n)
        source.end()
        if n == 0 or np.diff(place << KEYPOINT_BITS | keypoint).min(initial=1) <= 0 or table[-1] > key.id:
            raise ValueError("points must increase, and be born before they are seen again")
        self._references.told = self._untold_head(key, held, own)
        ends = np.searchsorted(place, np.arange(len(table)), side="right").tolist()
        born = [self._references.births(keyframe, held) for keyframe in table]
        masks = []
        for (versions, births), begin, end in zip(born, [0, *ends], ends, strict=False):
            parts = parts_at(births, keypoint[begin:end])
            masks.append(sum(1 << part for part in versions if part in parts))
        ways = self._references.poses(key.id, {a for a, m in zip(table, masks, strict=True) if m}, held)
        if self._references.camera(key.id, held) is None:
            ways = {}, []
        if not all(a in ways[0] for a, m in zip(table, masks, strict=True) if m):
            masks = [m if a in ways[0] else 0 for a, m in zip(table, masks, strict=True)]
            ways = self._references.poses(key.id, set(ways[0]), held)
        seen, octave, versions_used = self._foreseen(key.id, table, masks, place, keypoint, born, ways, held)
        out.varint(n)
        told = self._references.told
        out.varint(key.id - told.parent if told is not None else 0)
        if told is not None:
            for c in quantise.pose_codes(told.T_p_k):
                out.signed(c)
        _write_table(out, key.id, table, masks, place, keypoint)
        known = seen[0] >= 0
        shifts = _common_zeros(values[1:3]), _common_zeros(values[3:4])
        out.u8(shifts[0] << 4 | shifts[1])
        out.tight(np.stack([values[0] - np.arange(n), values[4] - octave]))
        out.tight(_differences(values[1:4, known], seen[:, known], shifts))
        out.tight(np.ascontiguousarray(values[1:4, ~known]))
        return versions_used

    def _grow_sightings(self, out: Writer, key: Key, source: Reader, held: Held) -> list[int]:
        n = source.varint(MAX_KEYPOINTS)
        self._references.told = _read_head(source, key)
        table, masks, place, keypoint = _read_table(source, key.id, n)
        born = [self._references.births(a, held) if m else _UNBORN for a, m in zip(table, masks, strict=True)]
        ways = self._references.poses(key.id, {a for a, m in zip(table, masks, strict=True) if m}, held)
        seen, octave, versions = self._foreseen(key.id, table, masks, place, keypoint, born, ways, held)
        shifts = _read_shifts(source)
        values = np.zeros((5, n), np.int64)
        values[[0, 4]] = source.tight(2, n)
        values[0] += np.arange(n)
        values[4] += octave
        known = seen[0] >= 0
        values[1:4, known] = _sums(source.tight(3, int(known.sum())), seen[:, known], shifts)
        values[1:4, ~known] = source.tight(3, int((~known).sum()))
        out.varint(n)
        out.columns(values)
        write_landmark_table(out, table, place, keypoint)
        return versions

    def _untold_head(self, key: Key, held: Held, own: Held) -> KeyframeHeader | None:
        """The keyframe's own header, when the peer is not known to hold it."""
        head_key = Key(KeyframeHeader.KIND, key.id)
        mine = own(head_key)
        if held(head_key) is not None or mine is None:
            return None
        head = messages.decode(head_key, mine[1])
        assert isinstance(head, KeyframeHeader)
        return None if head.parent == NO_KEYFRAME or head.parent >= key.id else head

    def _foreseen(
        self, keyframe: int, table: Sequence[int], masks: Sequence[int], place: I64, keypoint: I64,
        born: Sequence[tuple[dict[int, int], I32]], ways: tuple[dict[int, F64], list[int]], held: Held,
    ) -> tuple[I64, I64, list[int]]:  # fmt: skip
        """Codes (3, n) where points are foreseen (-1 where not), octaves (n,) of their births, versions used.

        table: keyframes of birth; masks: which of their parts of births both sides hold. place: (n,) increasing rows of
        the table. born: what `births` says of each. ways: what `poses` says of those with a mask. Raises WireError
        where they lack what the masks name.
        """
        n = len(place)
        codes = np.full((4, n), -1, np.int64)
        used: list[int] = []
        ends = np.searchsorted(place, np.arange(len(table)), side="right").tolist()
        for mask, (versions, births), begin, end in zip(masks, born, [0, *ends], ends, strict=False):
            if not mask:
                continue
            parts = [part for part in range(mask.bit_length()) if mask >> part & 1]
            if any(part not in versions for part in parts):
                raise WireError("a tight form builds upon births that are not held")
            used += [versions[part] for part in parts]
            kernels.pick(births, keypoint[begin:end], mask, codes[:, begin:end])
        octave = np.maximum(codes[3], 0)
        seen = np.full((3, n), -1, np.int64)
        if not any(masks):
            return seen, octave, used
        camera = self._references.camera(keyframe, held)
        poses, heads = ways
        if camera is None or any(mask and a not in poses for a, mask in zip(table, masks, strict=True)):
            raise WireError("a tight form builds upon headers that are not held")
        T_k_a = np.zeros((len(table), 4, 4))
        for i, a in enumerate(table):
            if a in poses:
                T_k_a[i] = poses[a]
        kernels.foresee(codes, place, T_k_a, camera[1], seen)
        return seen, octave, [*used, *heads, camera[0]]

    # ---- depths

    def _shrink_depths(self, out: Writer, key: Key, code: bytes, held: Held) -> list[int]:
        source = Reader(code)
        values = RefinedLandmarks.COLUMNS.read_codes(source)
        source.end()
        versions, births = self._references.births(key.id, held)
        out.varint(values.shape[1])
        out.varint(sum(1 << part for part in versions))
        seen = _seen_depths(births, versions, values[0])
        out.tight(np.stack([_gaps(values[0]), values[1] - seen, values[2], values[3]]))
        return [versions[part] for part in sorted(versions)]

    def _grow_depths(self, out: Writer, key: Key, source: Reader, held: Held) -> list[int]:
        n = source.varint(MAX_KEYPOINTS)
        mask = source.varint((1 << 16) - 1)
        values = source.tight(4, n)
        values[0] = np.cumsum(values[0] + 1) - 1
        versions, births = self._references.births(key.id, held)
        named = [part for part in range(mask.bit_length()) if mask >> part & 1]
        if not all(part in versions for part in named):
            raise WireError("a tight form builds upon births that are not held")
        if n and (values[0].min() < 0 or values[0].max() >= MAX_KEYPOINTS):
            raise WireError("a keypoint is out of range")
        values[1] += _seen_depths(births, named, values[0])
        out.varint(n)
        out.columns(values)
        return [versions[part] for part in named]


def _read_head(source: Reader, key: Key) -> KeyframeHeader | None:
    step = source.varint(MAX_KEYFRAME_ID)
    if not step:
        return None
    codes = [source.signed(quantise.TRANSLATION_CODES - 1 if i < 3 else quantise.ROTATION_STEPS) for i in range(6)]
    try:
        T_p_k = quantise.pose(tuple(codes))
    except ValueError as e:
        raise WireError(str(e)) from None
    return KeyframeHeader(KeyframeId(key.id), 0, KeyframeId(key.id - step), T_p_k, 0)


def _checksum(code: bytes, versions: Sequence[int]) -> bytes:
    return crc32(pack(f"<{len(versions)}q", *versions), crc32(code)).to_bytes(_CRC_BYTES, "little")


def _shrink_births(out: Writer, code: bytes) -> list[int]:
    source = Reader(code)
    values = NewLandmarks.COLUMNS.read_codes(source)
    n = values.shape[1]
    size = source.left // n if n else 0
    if size not in _DESCRIPTOR_SIZES:
        raise ValueError(f"descriptors take {size} bytes")
    out.varint(n << 2 | _DESCRIPTOR_SIZES.index(size))
    values[0] = _gaps(values[0])
    out.tight(values)
    out.raw(source.raw(size * n))
    source.end()
    return []


def _grow_births(out: Writer, source: Reader) -> list[int]:
    head = source.varint(MAX_KEYPOINTS << 2 | 2)
    if head & 3 >= len(_DESCRIPTOR_SIZES):
        raise WireError("descriptors of an unknown size")
    n = head >> 2
    values = source.tight(6, n)
    values[0] = np.cumsum(values[0] + 1) - 1
    out.varint(n)
    out.columns(values)
    out.raw(source.raw(_DESCRIPTOR_SIZES[head & 3] * n))
    return []


def _gaps(index: I64) -> I64:
    """How many numbers are left out before each of increasing ones."""
    return np.diff(index, prepend=-1) - 1


def _seen_depths(births: I32, parts: Sequence[int] | dict[int, int], index: I64) -> I64:
    """Codes (n,) of inverse depths as the agent saw them, 0 where none of the parts tells."""
    seen: I64 = np.zeros((4, len(index)), np.int64)
    kernels.pick(births, index, sum(1 << part for part in parts), seen)
    return np.asarray(seen[2])


# ---- points of sightings


def _write_table(out: Writer, id_: int, table: Sequence[int], masks: Sequence[int], place: I64, keypoint: I64) -> None:
    """Keyframes of birth as differences, newest first; how many points each has, masks of its parts; keypoints."""
    counts = np.bincount(place, minlength=len(table))
    out.varint(len(table))
    last = id_
    for i in range(len(table) - 1, -1, -1):
        out.varint(last - table[i])
        last = table[i]
    out.tight(np.stack([counts, np.array(masks)]).astype(np.int64))
    gaps = keypoint.copy()
    same = place[1:] == place[:-1]
    gaps[1:][same] -= keypoint[:-1][same] + 1
    out.tight(gaps[None, :])


def _read_table(source: Reader, id_: int, n: int) -> tuple[list[int], list[int], I64, I64]:
    size = source.varint(n)
    table, last = [0] * size, id_
    for i in range(size - 1, -1, -1):
        last -= source.varint(MAX_KEYFRAME_ID)
        if last < 0:
            raise WireError("a keyframe of birth is out of range")
        table[i] = last
    counts, masks = source.tight(2, size)
    if counts.min(initial=1) < 1 or counts.sum() != n or masks.min(initial=0) < 0 or masks.max(initial=0) >= 1 << 16:
        raise WireError("points do not add up")
    gaps = source.tight(1, n)[0]
    place = np.repeat(np.arange(size), counts)
    begin = np.cumsum(counts) - counts
    sums = np.cumsum(gaps + 1) - 1
    keypoint = sums - (sums[begin] - gaps[begin])[place] if n else gaps
    if n and (gaps.min() < 0 or keypoint.max() >= MAX_KEYPOINTS):
        raise WireError("a keypoint is out of range")
    return table, [int(m) for m in masks], place, keypoint


# ---- differences


def _common_zeros(codes: I64) -> int:
    """How many low bits are zero in all codes."""
    union = int(np.bitwise_or.reduce(codes.ravel())) if codes.size else 0
    return min(_MAX_SHIFT, (union & -union).bit_length() - 1) if union else 0


def _read_shifts(source: Reader) -> tuple[int, int]:
    both = source.u8()
    if both >> 4 > _MAX_SHIFT or both & 15 > _MAX_SHIFT:
        raise WireError("a step is out of range")
    return both >> 4, both & 15


def _differences(codes: I64, seen: I64, shifts: tuple[int, int]) -> I64:
    """(3, n): u and v less their prediction; inverse depth as 0 where unknown, else 1 + zigzag of the difference."""
    uv = (codes[:2] >> shifts[0]) - (seen[:2] >> shifts[0])
    depth = (codes[2] >> shifts[1]) - (seen[2] >> shifts[1])
    depth = np.where(codes[2] == 0, 0, 1 + np.where(depth >= 0, 2 * depth, -2 * depth - 1))
    return np.concatenate([uv, depth[None, :]])


def _sums(numbers: I64, seen: I64, shifts: tuple[int, int]) -> I64:
    """The inverse of `_differences`."""
    uv = (numbers[:2] + (seen[:2] >> shifts[0])) << shifts[0]
    z = np.maximum(numbers[2] - 1, 0)
    depth = (((z >> 1) ^ -(z & 1)) + (seen[2] >> shifts[1])) << shifts[1]
    return np.concatenate([uv, np.where(numbers[2] == 0, 0, depth)[None, :]])

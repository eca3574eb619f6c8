"""Residual codes of observations: differences from the predicted projections of the landmarks."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.residuals import prediction_kernels as kernels
from kiteline_codec.residuals.predictors import Held, Poses, Predictors, parts_at
from kiteline_codec.schema import Key, KeyframeHeader, Observations, messages
from kiteline_codec.schema.columns import read_landmark_table, write_landmark_table
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import MAX_KEYFRAME_ID
from kiteline_core.arrays import I32, I64
from kiteline_core.ids import KEYPOINT_BITS, MAX_KEYPOINTS, NO_KEYFRAME, KeyframeId

_MAX_SHIFT = 8
_NO_LANDMARKS: tuple[dict[int, int], I32] = ({}, np.empty((5, 0), np.int32))


@dataclass(frozen=True, slots=True)
class _Landmarks:
    """The observed landmarks. keyframes: of the landmarks, increasing. masks: the parts of their new landmarks that
    are used. place: (n,) increasing rows of `keyframes`. keypoint: (n,). codes: versions by part and codes of each
    keyframe's landmarks.
    """

    keyframes: Sequence[int]
    masks: Sequence[int]
    place: I64
    keypoint: I64
    codes: Sequence[tuple[dict[int, int], I32]]

    def used(self) -> set[int]:
        """The keyframes with a mask."""
        return {k for k, mask in zip(self.keyframes, self.masks, strict=True) if mask}


class ObservationResiduals:
    """Observations, predicted from the landmarks as the agent measured them and the poses of their keyframes."""

    def __init__(self, predictors: Predictors) -> None:
        self._predictors = predictors

    def compress(self, out: Writer, key: Key, code: bytes, held: Held, own: Held) -> list[int]:
        """Append the residual code. Returns the versions used. Raises ValueError or WireError."""
        source = Reader(code)
        values = Observations.COLUMNS.read_codes(source)
        n = values.shape[1]
        keyframes, place, keypoint = read_landmark_table(source, n)
        source.end()
        if n == 0 or np.diff(place << KEYPOINT_BITS | keypoint).min(initial=1) <= 0 or keyframes[-1] > key.id:
            raise ValueError("landmarks must increase, and be older than their observations")
        header = _header_to_send(key, held, own)
        ends = np.searchsorted(place, np.arange(len(keyframes)), side="right").tolist()
        codes = [self._predictors.landmarks(keyframe, held) for keyframe in keyframes]
        masks = []
        for (versions, landmarks), begin, end in zip(codes, [0, *ends], ends, strict=False):
            parts = parts_at(landmarks, keypoint[begin:end])
            masks.append(sum(1 << part for part in versions if part in parts))
        observed = _Landmarks(keyframes, masks, place, keypoint, codes)
        poses = self._predictors.poses(key.id, observed.used(), held, header)
        if self._predictors.camera(key.id, held) is None:
            poses = Poses({}, [])
        if observed.used() - poses.T_k_a.keys():
            masks = [mask if k in poses.T_k_a else 0 for k, mask in zip(keyframes, masks, strict=True)]
            observed = _Landmarks(keyframes, masks, place, keypoint, codes)
            poses = self._predictors.poses(key.id, set(poses.T_k_a), held, header)
        predicted, octave, versions_used = self._predict(key.id, observed, poses, held)
        out.varint(n)
        out.varint(0 if header is None else key.id - header.parent)
        if header is not None:
            write_pose(out, header.T_p_k)
        _write_landmarks(out, key.id, observed)
        known = predicted[0] >= 0
        shifts = _common_zeros(values[1:3]), _common_zeros(values[3:4])
        out.u8(shifts[0] << 4 | shifts[1])
        out.residual_columns(np.stack([values[0] - np.arange(n), values[4] - octave]))
        out.residual_columns(_differences(values[1:4, known], predicted[:, known], shifts))
        out.residual_columns(np.ascontiguousarray(values[1:4, ~known]))
        return versions_used

    def expand(self, out: Writer, key: Key, source: Reader, held: Held) -> list[int]:
        """Append the code. Returns the versions used. Raises WireError."""
        n = source.varint(MAX_KEYPOINTS)
        header = _read_header(source, key)
        keyframes, masks, place, keypoint = _read_landmarks(source, key.id, n)
        codes = [
            self._predictors.landmarks(k, held) if mask else _NO_LANDMARKS
            for k, mask in zip(keyframes, masks, strict=True)
        ]
        observed = _Landmarks(keyframes, masks, place, keypoint, codes)
        poses = self._predictors.poses(key.id, observed.used(), held, header)
        predicted, octave, versions = self._predict(key.id, observed, poses, held)
        shifts = _read_shifts(source)
        values = np.zeros((5, n), np.int64)
        values[[0, 4]] = source.residual_columns(2, n)
        values[0] += np.arange(n)
        values[4] += octave
        known = predicted[0] >= 0
        values[1:4, known] = _sums(source.residual_columns(3, int(known.sum())), predicted[:, known], shifts)
        values[1:4, ~known] = source.residual_columns(3, int((~known).sum()))
        out.varint(n)
        out.columns(values)
        write_landmark_table(out, keyframes, place, keypoint)
        return versions

    def _predict(self, keyframe: int, observed: _Landmarks, poses: Poses, held: Held) -> tuple[I64, I64, list[int]]:
        """Predicted codes (3, n) of u, v and inverse depth, -1 where unknown; octaves (n,); the versions used.

        Raises WireError where predictors that the masks name are not held.
        """
        n = len(observed.place)
        codes = np.full((4, n), -1, np.int64)
        used: list[int] = []
        ends = np.searchsorted(observed.place, np.arange(len(observed.keyframes)), side="right").tolist()
        rows = zip(observed.masks, observed.codes, [0, *ends], ends, strict=False)
        for mask, (versions, landmarks), begin, end in rows:
            if not mask:
                continue
            parts = _parts_of(mask)
            if not versions.keys() >= {*parts}:
                raise WireError("a residual code is predicted from landmarks that are not held")
            used += [versions[part] for part in parts]
            kernels.select(landmarks, observed.keypoint[begin:end], mask, begin, codes)
        octave = np.maximum(codes[3], 0)
        predicted = np.full((3, n), -1, np.int64)
        if not any(observed.masks):
            return predicted, octave, used
        camera = self._predictors.camera(keyframe, held)
        if camera is None or observed.used() - poses.T_k_a.keys():
            raise WireError("a residual code is predicted from headers that are not held")
        T_k_a = np.zeros((len(observed.keyframes), 4, 4))
        for i, a in enumerate(observed.keyframes):
            if a in poses.T_k_a:
                T_k_a[i] = poses.T_k_a[a]
        kernels.predict(codes, observed.place, T_k_a, camera[1], predicted)
        return predicted, octave, [*used, *poses.versions, camera[0]]


@lru_cache(256)
def _parts_of(mask: int) -> tuple[int, ...]:
    """The parts that a mask names."""
    return tuple(part for part in range(mask.bit_length()) if mask >> part & 1)


def _header_to_send(key: Key, held: Held, own: Held) -> KeyframeHeader | None:
    """The keyframe's own header, if the peer is not known to hold it."""
    header_key = Key(KeyframeHeader.KIND, key.id)
    ours = own(header_key)
    if held(header_key) is not None or ours is None:
        return None
    header = messages.decode(header_key, ours[1])
    assert isinstance(header, KeyframeHeader)
    return None if header.parent == NO_KEYFRAME or header.parent >= key.id else header


def _read_header(source: Reader, key: Key) -> KeyframeHeader | None:
    step = source.varint(MAX_KEYFRAME_ID)
    if not step:
        return None
    return KeyframeHeader(KeyframeId(key.id), 0, KeyframeId(key.id - step), read_pose(source), 0)


def _write_landmarks(out: Writer, id_: int, observed: _Landmarks) -> None:
    """Append keyframes as differences, newest first; of each the number of landmarks and the mask; keypoints."""
    keyframes, place, keypoint = observed.keyframes, observed.place, observed.keypoint
    counts = np.bincount(place, minlength=len(keyframes))
    out.varint(len(keyframes))
    last = id_
    for keyframe in reversed(keyframes):
        out.varint(last - keyframe)
        last = keyframe
    out.residual_columns(np.stack([counts, np.array(observed.masks)]).astype(np.int64))
    gaps = keypoint.copy()
    same = place[1:] == place[:-1]
    gaps[1:][same] -= keypoint[:-1][same] + 1
    out.residual_columns(gaps[None, :])


def _read_landmarks(source: Reader, id_: int, n: int) -> tuple[list[int], list[int], I64, I64]:
    """Keyframes, masks, places and keypoints, as `_write_landmarks` wrote them. Raises WireError."""
    size = source.varint(n)
    keyframes, last = [0] * size, id_
    for i in range(size - 1, -1, -1):
        last -= source.varint(MAX_KEYFRAME_ID)
        if last < 0:
            raise WireError("a keyframe of landmarks is out of range")
        keyframes[i] = last
    counts, masks = source.residual_columns(2, size)
    if counts.min(initial=1) < 1 or counts.sum() != n or masks.min(initial=0) < 0 or masks.max(initial=0) >= 1 << 16:
        raise WireError("numbers of landmarks do not add up")
    gaps = source.residual_columns(1, n)[0]
    place = np.repeat(np.arange(size), counts)
    begin = np.cumsum(counts) - counts
    sums = np.cumsum(gaps + 1) - 1
    keypoint = sums - (sums[begin] - gaps[begin])[place] if n else gaps
    if n and (gaps.min() < 0 or keypoint.max() >= MAX_KEYPOINTS):
        raise WireError("a keypoint is out of range")
    return keyframes, [int(m) for m in masks], place, keypoint


# ---- differences


def _common_zeros(codes: I64) -> int:
    """The number of low bits that are zero in all codes."""
    union = int(np.bitwise_or.reduce(codes.ravel())) if codes.size else 0
    return min(_MAX_SHIFT, (union & -union).bit_length() - 1) if union else 0


def _read_shifts(source: Reader) -> tuple[int, int]:
    both = source.u8()
    if both >> 4 > _MAX_SHIFT or both & 15 > _MAX_SHIFT:
        raise WireError("a step is out of range")
    return both >> 4, both & 15


def _differences(codes: I64, predicted: I64, shifts: tuple[int, int]) -> I64:
    """(3, n): u and v less their prediction; inverse depth as 0 where unknown, else 1 + zigzag of the difference."""
    uv = (codes[:2] >> shifts[0]) - (predicted[:2] >> shifts[0])
    depth = (codes[2] >> shifts[1]) - (predicted[2] >> shifts[1])
    depth = np.where(codes[2] == 0, 0, 1 + np.where(depth >= 0, 2 * depth, -2 * depth - 1))
    return np.concatenate([uv, depth[None, :]])


def _sums(numbers: I64, predicted: I64, shifts: tuple[int, int]) -> I64:
    """The inverse of `_differences`."""
    uv = (numbers[:2] + (predicted[:2] >> shifts[0])) << shifts[0]
    z = np.maximum(numbers[2] - 1, 0)
    depth = (((z >> 1) ^ -(z & 1)) + (predicted[2] >> shifts[1])) << shifts[1]
    return np.concatenate([uv, np.where(numbers[2] == 0, 0, depth)[None, :]])

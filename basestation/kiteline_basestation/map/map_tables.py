"""The tables of the sparse map: one row a keyframe, one row a keypoint, with spare capacity."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

EMPTY, LANDMARK, OBSERVATION = 0, 1, 2  # what a keypoint is
REMOVED, CULLED, REFINED = 1, 2, 4  # bits of its flags: observation rejected; point dropped; point has a base value
NO_POSE, COMPOSED, REFINED_POSE = 0, 1, 2  # where a keyframe's pose comes from


@dataclass(slots=True)
class KeyframeTable:
    """One row a keyframe, in order of arrival. Arrays have spare capacity: only the first `len(map)` rows count."""

    id: I64
    t_ns: I64
    parent: I64  # keyframe id, NO_KEYFRAME for the first of a submap
    T_p_k: F64  # (n,4,4) in the parent, as the agent wrote it
    T_m_k: F64  # (n,4,4) in the submap: the base's value, else composed from the parent's
    T_w_k: F64  # (n,4,4) in the frame in which all submaps lie: T_w_m of its submap times T_m_k
    pose_source: U8
    start: I32  # first slot of its keypoints
    count: I32  # number of keypoints
    filled: I32  # number of keypoints that have arrived
    culled: U8  # 1: its observations no longer count
    camera: F64  # (n,5) fx fy cx cy bf in px and px*m
    unit: F64  # (n,) units of w in one of its submap: 1 but where a submap of one eye lies in a map of another unit


@dataclass(slots=True)
class KeypointTable:
    """One row (slot) a keypoint. Arrays have spare capacity: only the first `slots` rows count."""

    uv: F32  # (n,2) px
    inv_depth: F32  # 1/m as the agent saw it, 0 unknown
    octave: U8
    angle: U8  # 1/256 turns
    kind: U8  # EMPTY, BIRTH, SIGHTING
    part: U8  # section from which it came
    flags: U8
    usable: U8  # 1: a valid observation: present, not removed, of a keyframe that has a pose and is not culled
    point: I64  # id of the point that a sighting names; NO_POINT for a birth
    row: I32  # row of its keyframe
    root: I32  # slot of the point it observes, -1 while unknown
    first: I32  # newest observation that hangs on the point born here, -1 none
    next: I32  # next observation of the same point, -1 none
    refined: F32  # 1/m: inverse depth of the point born here by the base, valid with flag REFINED
    offset: F32  # (n,2) px from the keypoint to the point's bearing by the base
    descriptor: U8  # (n,32) of a birth


def grow(table: KeyframeTable | KeypointTable, capacity: int) -> None:
    """Give a table room for `capacity` rows; new ones are zero."""
    for field in fields(table):
        old = getattr(table, field.name)
        new = np.zeros((capacity, *old.shape[1:]), old.dtype)
        new[: len(old)] = old
        setattr(table, field.name, new)


def empty_keyframes() -> KeyframeTable:
    """A table without rows."""
    i64, u8, i32 = np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, np.int32)
    t = np.zeros((0, 4, 4))
    return KeyframeTable(i64, i64, i64, t, t, t, u8, i32, i32, i32, u8, np.zeros((0, 5)), np.zeros(0))


def empty_keypoints() -> KeypointTable:
    """A table without rows."""
    f32, u8, i32 = np.zeros(0, np.float32), np.zeros(0, np.uint8), np.zeros(0, np.int32)
    f32x2 = np.zeros((0, 2), np.float32)
    return KeypointTable(
        f32x2, f32, u8, u8, u8, u8, u8, u8, np.zeros(0, np.int64), i32, i32, i32, i32, f32, f32x2,
        np.zeros((0, 32), np.uint8),
    )  # fmt: skip

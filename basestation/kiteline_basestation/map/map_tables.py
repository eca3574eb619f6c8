"""Tables of the sparse map: one row per keyframe, one row per keypoint, with spare capacity."""

from array import array
from dataclasses import dataclass, fields

import numpy as np

from kiteline_core.arrays import F32, F64, I32, I64, U8

EMPTY, LANDMARK, OBSERVATION = 0, 1, 2  # keypoint: not received yet, first observation of a new landmark, observation
REMOVED, CULLED, REFINED = 1, 2, 4  # flag bits: observation rejected, landmark culled, landmark refined by the base
NO_POSE, COMPOSED, REFINED_POSE = 0, 1, 2  # keyframe pose: unknown, composed from its parent's, refined by the base


@dataclass(slots=True)
class KeyframeTable:
    """One row per keyframe, in order of arrival; only the first `len(map)` rows are used."""

    id: I64
    t_ns: I64
    parent: I64  # keyframe id, NO_KEYFRAME for the first of a submap
    T_p_k: F64  # (n,4,4) pose in the parent, as the agent sent it
    T_m_k: F64  # (n,4,4) pose in the submap: refined, else composed from the parent's
    T_w_k: F64  # (n,4,4) pose in w, without the submap's scale
    pose_source: U8
    start: I32  # first slot of its keypoints
    count: I32  # number of keypoints
    filled: I32  # number of keypoints that have arrived
    usable: I32  # number of keypoints that are usable
    live: I32  # number of root landmarks that are not culled
    culled: U8  # 1: its observations are not used any more
    camera: F64  # (n,5) fx fy cx cy bf in px and px*m
    scale: F64  # (n,) length in w of one unit of the submap; 1 unless the submap is monocular


class LandmarkDescriptors:
    """Descriptors (n,32) by slot; zero, and not held, where none was set: most keypoints are observations."""

    def __init__(self) -> None:
        self._row = np.zeros(0, np.int32)  # of each slot in `_held`; 0: none
        self._held = np.zeros((1, 32), np.uint8)
        self._top = 1  # rows in use, or free for the next ones
        self._free = array("i")

    def __getitem__(self, slots: I32) -> U8:
        """Descriptors (n,32) at slots (n,); a copy."""
        return self._held[self._row[slots]]

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return self._row.nbytes + self._held.nbytes

    def put(self, slots: I32, descriptors: U8) -> None:
        """Set the descriptors (n,32) of different slots (n,)."""
        fresh = slots[self._row[slots] == 0]
        reused = min(len(self._free), len(fresh))
        for slot in fresh[:reused].tolist():
            self._row[slot] = self._free.pop()
        new = len(fresh) - reused
        if self._top + new > len(self._held):
            held = np.zeros((self._top + new + max(4096, self._top // 4), 32), np.uint8)
            held[: self._top] = self._held[: self._top]
            self._held = held
        self._row[fresh[reused:]] = np.arange(self._top, self._top + new, dtype=np.int32)
        self._top += new
        self._held[self._row[slots]] = descriptors

    def grow(self, capacity: int) -> None:
        """Make room for `capacity` slots."""
        row = np.zeros(capacity, np.int32)
        row[: len(self._row)] = self._row
        self._row = row

    def clear(self, slots: I32) -> None:
        """Drop the descriptors of different slots (n,)."""
        rows = self._row[slots]
        self._free.extend(rows[rows > 0].tolist())
        self._row[slots] = 0


@dataclass(slots=True)
class KeypointTable:
    """One row (slot) per keypoint; only the first `slots` rows are used."""

    uv: F32  # (n,2) px
    inv_depth: F32  # 1/m as the agent measured it, 0 unknown
    octave: U8
    angle: U8  # 1/256 turns
    kind: U8  # EMPTY, LANDMARK, OBSERVATION
    part: U8  # part of the keyframe's records in which it arrived
    flags: U8
    usable: U8  # 1: received, not removed, and the keyframe has a pose and is not culled
    landmark: I64  # id of the landmark that an OBSERVATION names, else NO_LANDMARK
    row: I32  # row of the keyframe
    root: I32  # slot of the root landmark that it observes, -1 unknown
    first: I32  # of a landmark: slot of its newest observation, -1 none
    next: I32  # slot of the next observation of the same landmark, -1 none
    refined: F32  # of a landmark with flag REFINED: inverse depth in 1/m
    offset: F32  # (n,2) of a landmark: px from the keypoint to its refined projection
    descriptor: LandmarkDescriptors  # (n,32) of a landmark


def grow(table: KeyframeTable | KeypointTable, capacity: int) -> None:
    """Enlarge a table to `capacity` rows; new rows are zero."""
    for field in fields(table):
        old = getattr(table, field.name)
        if isinstance(old, LandmarkDescriptors):
            old.grow(capacity)
            continue
        new = np.zeros((capacity, *old.shape[1:]), old.dtype)
        new[: len(old)] = old
        setattr(table, field.name, new)


def clear(table: KeyframeTable | KeypointTable, rows: I32) -> None:
    """Set rows (n,) to zero, as new ones are."""
    for field in fields(table):
        held = getattr(table, field.name)
        if isinstance(held, LandmarkDescriptors):
            held.clear(rows)
        else:
            held[rows] = 0


def empty_keyframes() -> KeyframeTable:
    """A keyframe table without rows."""
    i64, u8, i32 = np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, np.int32)
    t = np.zeros((0, 4, 4))
    return KeyframeTable(i64, i64, i64, t, t, t, u8, i32, i32, i32, i32, i32, u8, np.zeros((0, 5)), np.zeros(0))


def empty_keypoints() -> KeypointTable:
    """A keypoint table without rows."""
    f32, u8, i32 = np.zeros(0, np.float32), np.zeros(0, np.uint8), np.zeros(0, np.int32)
    f32x2 = np.zeros((0, 2), np.float32)
    return KeypointTable(
        f32x2, f32, u8, u8, u8, u8, u8, u8, np.zeros(0, np.int64), i32, i32, i32, i32, f32, f32x2,
        LandmarkDescriptors(),
    )  # fmt: skip

"""Collects changes of the map as records for the agents that own the keyframes."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import PublishConfig
from kiteline_basestation.exchange.correction_batches import MEMBERS
from kiteline_basestation.map.map_tables import CULLED, LANDMARK, REFINED, REFINED_POSE, REMOVED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import (
    CulledLandmarks,
    FusedLandmarks,
    Key,
    KeyframePose,
    Record,
    RefinedLandmarks,
    RemovedObservations,
    SubmapPlacement,
    messages,
)
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, agent_of_keyframe, agent_of_submap, submap_of_keyframe

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

_MEMBER_KINDS = frozenset(record.KIND for record in MEMBERS)
_POSE_BYTES = 24  # of a keyframe's pose on the wire, and of what else stands beside landmarks
_LANDMARK_BYTES = 4  # of a refined landmark as a residual

_Mark = tuple[int, KeyframeId]  # KIND of a record, and the keyframe that it is of
Published = tuple[tuple[AgentId, tuple[Record, ...]], ...]


class Publisher:
    """The base's changed values. A record holds a whole value, so that a later one replaces an earlier one."""

    def __init__(self, sparse_map: SparseMap, config: PublishConfig | None = None) -> None:
        self._map = sparse_map
        self._most = (config or PublishConfig()).batch_values
        self._dirty: dict[_Mark, None] = {}
        self._moves: dict[AgentId, dict[_Mark, None]] = {}  # what moves an agent's map; what has waited longest first
        self._records: list[tuple[AgentId, Record]] = []

    def mark_changed(self, kind: int, keyframe: KeyframeId) -> None:
        """Mark a value of a keyframe as changed. kind: KIND of a record class."""
        marks = self._moves.setdefault(agent_of_keyframe(keyframe), {}) if kind in _MEMBER_KINDS else self._dirty
        marks.setdefault((int(kind), keyframe))

    def mark_changed_slots(self, kind: int, slots: I32) -> None:
        """Mark a value of the keyframes that own slots (n,) as changed."""
        for keyframe in np.unique(self._map.keyframes.id[self._map.keypoints.row[slots]]).tolist():
            self.mark_changed(kind, KeyframeId(keyframe))

    def publish_placement(self, submap: SubmapId, S_w_m: F64, *, recognised: bool, scale_sigma: float) -> None:
        """Send where a submap lies in w, as a similarity (4,4), and how certain lengths there are; see the record."""
        record = SubmapPlacement(submap, S_w_m, recognised, scale_sigma=scale_sigma)
        self._records.append((agent_of_submap(submap), record))

    def withdraw_placement(self, submap: SubmapId) -> None:
        """Drop placements of a submap that have not been sent yet."""
        self._records = [
            (a, r) for a, r in self._records if not (isinstance(r, SubmapPlacement) and r.submap == submap)
        ]  # fmt: skip

    def send(self, agent: AgentId, record: Record) -> None:
        """Send any other record."""
        self._records.append((agent, record))

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Drop changes of deleted submaps that have not been sent."""
        for marks in (self._dirty, *self._moves.values()):
            for mark in [m for m in marks if submap_of_keyframe(m[1]) in submaps]:
                del marks[mark]

    @property
    def waiting(self) -> bool:
        """True if changes wait for room."""
        return bool(self._dirty or self._records or any(self._moves.values()))

    def collect(self, room_bytes: Mapping[AgentId, int] | None = None) -> Published:
        """The changes since the last call for which there is room, by agent, in order of kind and keyframe.

        room_bytes: for corrections that move the agent's map; no limit for agents that are not in it. What waits is
        sent at its newest value later.
        """
        room = dict(room_bytes or {})
        out: dict[AgentId, dict[Key, Record]] = {}
        records, self._records = self._records, []
        for agent, record in records:
            if isinstance(record, MEMBERS) and room.get(agent) == 0:
                self._records.append((agent, record))
            else:
                out.setdefault(agent, {})[messages.key(record)] = record
        for kind, keyframe in sorted(self._in_turn(room)):
            made = self._record(kind, keyframe)
            if made is not None:
                out.setdefault(agent_of_keyframe(keyframe), {})[messages.key(made)] = made
        return tuple((agent, tuple(found.values())) for agent, found in sorted(out.items()))

    def _in_turn(self, room: Mapping[AgentId, int]) -> list[_Mark]:
        """Take the changes for which there is room: all poses, then landmarks of the keyframe that has waited longest
        and of the newest ones. In a room above 0 at least one change is taken, and never more than a batch holds.
        """
        taken, self._dirty = list(self._dirty), {}
        for agent, marks in self._moves.items():
            left = room.get(agent)
            if left is None and len(marks) <= self._most:
                taken += marks
                marks.clear()
            elif left != 0:
                taken += self._batch(marks, left)
        return taken

    def _batch(self, marks: dict[_Mark, None], left: int | None) -> list[_Mark]:
        """Take as many of an agent's changes as `left` bytes hold."""
        poses = sorted((m for m in marks if m[0] == KeyframePose.KIND), key=lambda m: -m[1])
        others = [m for m in marks if m[0] != KeyframePose.KIND]
        taken: list[_Mark] = []
        for mark in poses + others[:1] + sorted(others[1:], key=lambda m: -m[1]):
            if len(taken) == self._most or (left is not None and left <= 0):
                break
            if left is not None:
                left -= self._bytes(*mark)
            taken.append(mark)
            del marks[mark]
        return taken

    def _bytes(self, kind: int, keyframe: KeyframeId) -> int:
        """About what a change takes on the wire."""
        if kind == KeyframePose.KIND:
            return _POSE_BYTES
        slots = self._map.slots_of(keyframe)
        return _POSE_BYTES + _LANDMARK_BYTES * int(np.count_nonzero(self._map.keypoints.flags[slots] & REFINED))

    def _record(self, kind: int, keyframe: KeyframeId) -> Record | None:
        sparse_map, table = self._map, self._map.keypoints
        slots = sparse_map.slots_of(keyframe)
        row = sparse_map.rows[keyframe]
        is_landmark = table.kind[slots] == LANDMARK
        if kind == KeyframePose.KIND:
            if sparse_map.keyframes.pose_source[row] != REFINED_POSE:
                return None
            return KeyframePose(keyframe, sparse_map.keyframes.T_m_k[row].copy())
        if kind == RefinedLandmarks.KIND:
            here = slots[
                is_landmark & (table.flags[slots] & (REFINED | CULLED) == REFINED) & (table.root[slots] == slots)
            ]
            return RefinedLandmarks(keyframe, self._index(here), table.refined[here].copy(), table.offset[here].copy())
        if kind == FusedLandmarks.KIND:
            here = slots[is_landmark & (table.root[slots] != slots)]
            return FusedLandmarks(keyframe, self._index(here), sparse_map.landmark_ids(table.root[here]))
        if kind == RemovedObservations.KIND:
            return RemovedObservations(keyframe, self._index(slots[table.flags[slots] & REMOVED != 0]))
        if kind == CulledLandmarks.KIND:
            here = slots[is_landmark & (table.flags[slots] & CULLED != 0)]
            return CulledLandmarks(keyframe, self._index(here), int(sparse_map.keyframes.culled[row]))
        raise ValueError(f"the base writes record of kind {kind} for a keyframe")

    def _index(self, slots: I32) -> NDArray[np.uint16]:
        return self._map.keypoint_of(slots).astype(np.uint16)


def apply_record(sparse_map: SparseMap, record: Record) -> None:
    """Apply a record of the base to the map: the quantised value just sent, or one that an earlier base stored.

    Records of unknown keyframes change nothing.
    """
    if (
        not isinstance(record, KeyframePose | RefinedLandmarks | FusedLandmarks | RemovedObservations | CulledLandmarks)
        or record.keyframe not in sparse_map
    ):
        return
    if isinstance(record, KeyframePose):
        sparse_map.set_pose(record.keyframe, record.T_m_k)
        return
    row = sparse_map.rows[record.keyframe]
    known = record.index < sparse_map.keyframes.count[row]
    slots = (int(sparse_map.keyframes.start[row]) + record.index[known].astype(np.int32)).astype(np.int32)
    flags = sparse_map.keypoints.flags
    if isinstance(record, RefinedLandmarks):
        sparse_map.set_depths(slots, record.inv_depth[known], record.offset[known])
    elif isinstance(record, FusedLandmarks):
        roots = sparse_map.find_landmarks(record.point[known])
        for slot, root in zip(slots.tolist(), roots.tolist()):
            if root >= 0 and sparse_map.keypoints.root[slot] == slot != root:
                sparse_map.fuse(slot, int(sparse_map.keypoints.root[root]))
    else:
        bit = REMOVED if isinstance(record, RemovedObservations) else CULLED
        fresh = slots[flags[slots] & bit == 0]
        if len(fresh):
            sparse_map.set_flags(fresh, bit)
        if isinstance(record, CulledLandmarks) and record.keyframe_too:
            sparse_map.cull_keyframe(record.keyframe)

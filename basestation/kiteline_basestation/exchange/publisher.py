"""Collects changes of the map as records for the agents that own the keyframes."""

from collections import deque
from collections.abc import Collection, Iterable, Mapping
from itertools import chain, islice

import numpy as np

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
from kiteline_codec.schema.owners import submap_of
from kiteline_core.arrays import F64, I32, U16
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, agent_of_keyframe, agent_of_submap, submap_of_keyframe

_MEMBER_KINDS = frozenset(record.KIND for record in MEMBERS)
_POSE_BYTES = 24  # of a keyframe's pose on the wire, and of what else stands beside landmarks
_LANDMARK_BYTES = 4  # of a refined landmark as a residual

_Mark = tuple[int, KeyframeId]  # KIND of a record, and the keyframe that it is of
Published = tuple[tuple[AgentId, tuple[Record, ...]], ...]


class _Moves:
    """What moves the map of one agent and has not been sent.

    batch: values of the batch that is being sent, as they were when it was chosen, the next one first. poses: keyframes
    that changed. others: other changes, what has waited longest first.
    """

    def __init__(self) -> None:
        self.batch: deque[Record] = deque()
        self.poses: dict[KeyframeId, None] = {}
        self.others: dict[_Mark, None] = {}

    def __bool__(self) -> bool:
        return bool(self.batch or self.poses or self.others)

    def add(self, kind: int, keyframe: KeyframeId) -> None:
        """Add a change. One of a value of the batch goes with the next batch."""
        if kind == KeyframePose.KIND:
            self.poses.setdefault(keyframe)
        else:
            self.others.setdefault((kind, keyframe))

    def has(self, kind: int, keyframe: KeyframeId) -> bool:
        """True if a value has changed and was not chosen for a batch since."""
        return keyframe in self.poses if kind == KeyframePose.KIND else (kind, keyframe) in self.others

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Drop the changes of some submaps."""
        self.batch = deque(record for record in self.batch if submap_of(messages.key(record)) not in submaps)
        self.poses = {keyframe: None for keyframe in self.poses if submap_of_keyframe(keyframe) not in submaps}
        self.others = {mark: None for mark in self.others if submap_of_keyframe(mark[1]) not in submaps}


class Publisher:
    """The base's changed values. A record holds a whole value, so that a later one replaces an earlier one."""

    def __init__(self, sparse_map: SparseMap, config: PublishConfig | None = None) -> None:
        self._map = sparse_map
        self._config = config or PublishConfig()
        self._dirty: dict[_Mark, None] = {}
        self._whole = False  # all of them are sent in the next call of `collect`
        self._moves: dict[AgentId, _Moves] = {}
        self._records: list[tuple[AgentId, Record]] = []
        self._urgent: list[tuple[AgentId, SubmapPlacement]] = []

    def mark_changed(self, kind: int, keyframe: KeyframeId) -> None:
        """Mark a value of a keyframe as changed. kind: KIND of a record class."""
        if kind not in _MEMBER_KINDS:
            self._dirty.setdefault((int(kind), keyframe))
            return
        moves = self._moves.get(agent := agent_of_keyframe(keyframe))
        if moves is None:
            moves = self._moves[agent] = _Moves()
        moves.add(int(kind), keyframe)

    def mark_deleted(self, keyframe: KeyframeId) -> None:
        """Mark a keyframe as culled that will be forgotten once the next call of `collect` has published that."""
        self.mark_changed(CulledLandmarks.KIND, keyframe)
        self._whole = True

    def mark_changed_slots(self, kind: int, slots: I32) -> None:
        """Mark a value of the keyframes that own slots (n,) as changed."""
        for keyframe in np.unique(self._map.keyframes.id[self._map.keypoints.row[slots]]).tolist():
            self.mark_changed(kind, KeyframeId(keyframe))

    def publish_placement(
        self, submap: SubmapId, S_w_m: F64, *, recognised: bool, scale_sigma: float, urgent: bool
    ) -> None:
        """Send where a submap lies in w, as a similarity (4,4), and how certain lengths there are; see the record.

        urgent: before corrections that wait, which move the agent's map by less.
        """
        record = SubmapPlacement(submap, S_w_m, recognised, scale_sigma=scale_sigma)
        if urgent:
            self.withdraw_placement(submap)
            self._urgent.append((agent_of_submap(submap), record))
        else:
            self._records.append((agent_of_submap(submap), record))

    def withdraw_placement(self, submap: SubmapId) -> None:
        """Drop placements of a submap that have not been sent yet."""
        self._records = [
            (a, r) for a, r in self._records if not (isinstance(r, SubmapPlacement) and r.submap == submap)
        ]  # fmt: skip
        self._urgent = [(agent, record) for agent, record in self._urgent if record.submap != submap]

    def take_urgent(self) -> tuple[tuple[AgentId, SubmapPlacement], ...]:
        """Placements that go before all else."""
        urgent, self._urgent = self._urgent, []
        return tuple(urgent)

    def send(self, agent: AgentId, record: Record) -> None:
        """Send any other record."""
        self._records.append((agent, record))

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Drop changes of deleted submaps that have not been sent."""
        self._dirty = {mark: None for mark in self._dirty if submap_of_keyframe(mark[1]) not in submaps}
        for moves in self._moves.values():
            moves.forget(submaps)

    def adopt(self, record: Record) -> None:
        """Replace a value by its quantised code, as the agent will hold it, unless it has changed since."""
        if isinstance(record, KeyframePose | RefinedLandmarks):
            moves = self._moves.get(agent_of_keyframe(record.keyframe))
            if moves is not None and moves.has(record.KIND, record.keyframe):
                return
        apply_record(self._map, record)

    @property
    def waiting(self) -> bool:
        """True if changes wait for room."""
        return bool(self._dirty or self._records or self._urgent or any(self._moves.values()))

    @property
    def unfinished(self) -> frozenset[AgentId]:
        """Agents whose batch of corrections goes on with the next call of `collect`."""
        return frozenset(agent for agent, moves in self._moves.items() if moves.batch)

    def collect(self, room_bytes: Mapping[AgentId, int] | None = None) -> Published:
        """The changes since the last call for which there is room, by agent, in order of kind and keyframe.

        room_bytes: for corrections that move the agent's map; no limit for agents that are not in it. What waits is
        sent at its newest value later, but values of a batch that goes on as they were when it was chosen.
        """
        room = dict(room_bytes or {})
        out: dict[AgentId, dict[Key, Record]] = {}
        records, self._records = self._records, []
        for agent, record in records:
            if isinstance(record, MEMBERS) and (room.get(agent) == 0 or agent in self.unfinished):
                self._records.append((agent, record))
            else:
                out.setdefault(agent, {})[messages.key(record)] = record
        for key, made in sorted(((messages.key(r), r) for r in self._in_turn(room)), key=lambda found: found[0]):
            out.setdefault(agent_of_keyframe(KeyframeId(key.id)), {})[key] = made
        return tuple((agent, tuple(found.values())) for agent, found in sorted(out.items()))

    def _in_turn(self, room: Mapping[AgentId, int]) -> list[Record]:
        """Take the changes of one step. A batch is chosen where there is room, and taken over several steps if it is
        large; in a room above 0 it has at least one change.
        """
        most = None if self._whole else self._config.step_values
        taken, self._whole = list(islice(self._dirty, most)), False  # what moves nothing: it waits for no other values
        for mark in taken:
            del self._dirty[mark]
        records = self._records_of(taken)
        for agent, moves in self._moves.items():
            if not moves.batch and room.get(agent) != 0:
                # As they are now: what a job changes while they are sent would not fit those that left before.
                moves.batch.extend(self._records_of(self._choose(moves, room.get(agent))))
            records += [moves.batch.popleft() for _ in range(min(len(moves.batch), self._config.step_values))]
        return records

    def _records_of(self, marks: Iterable[_Mark]) -> list[Record]:
        made = (self._record(kind, keyframe) for kind, keyframe in marks)
        return [record for record in made if record is not None]

    def _choose(self, moves: _Moves, left: int | None) -> list[_Mark]:
        """Take as many of an agent's changes as a batch and `left` bytes hold: all poses, the newest first, then
        landmarks of the keyframe that has waited longest and of the newest ones.
        """
        kind, out = KeyframePose.KIND, list[_Mark]()
        others = list(moves.others)
        poses = ((kind, keyframe) for keyframe in sorted(moves.poses, reverse=True))
        for mark in chain(poses, others[:1], sorted(others[1:], key=lambda m: -m[1])):
            if len(out) == self._config.batch_values or (left is not None and left <= 0):
                break
            if left is not None:
                left -= self._bytes(*mark)
            out.append(mark)
            if mark[0] == kind:
                del moves.poses[mark[1]]
            else:
                del moves.others[mark]
        return out

    def _bytes(self, kind: int, keyframe: KeyframeId) -> int:
        """About what a change takes on the wire."""
        if kind == KeyframePose.KIND:
            return _POSE_BYTES
        slots = self._map.slots_of(keyframe)
        return _POSE_BYTES + _LANDMARK_BYTES * int(np.count_nonzero(self._map.keypoints.flags[slots] & REFINED))

    def _record(self, kind: int, keyframe: KeyframeId) -> Record | None:
        sparse_map, table = self._map, self._map.keypoints
        row = sparse_map.rows[keyframe]
        if kind == KeyframePose.KIND:
            if sparse_map.keyframes.pose_source[row] != REFINED_POSE:
                return None
            return KeyframePose(keyframe, sparse_map.keyframes.T_m_k[row].copy())
        slots = sparse_map.slots_of(keyframe)
        is_landmark = table.kind[slots] == LANDMARK
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

    def _index(self, slots: I32) -> U16:
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
        named, root = sparse_map.find_landmarks(record.point[known]), sparse_map.keypoints.root
        for slot, other in zip(slots.tolist(), named.tolist()):
            # What a store has lost is no landmark, and leads to none.
            if other >= 0 and root[other] >= 0 and root[slot] == slot != root[other]:
                sparse_map.fuse(slot, int(root[other]))
    else:
        bit = REMOVED if isinstance(record, RemovedObservations) else CULLED
        fresh = slots[flags[slots] & bit == 0]
        if len(fresh):
            sparse_map.set_flags(fresh, bit)
        if isinstance(record, CulledLandmarks) and record.keyframe_too:
            sparse_map.cull_keyframe(record.keyframe)

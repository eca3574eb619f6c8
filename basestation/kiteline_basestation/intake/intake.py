"""Takes up what the agents wrote, in whatever order it comes, and says which keyframes are ready to be used."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from kiteline_basestation.config import IntakeConfig
from kiteline_basestation.map.map_tables import NO_POSE
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.store.state import Json, matrix, pose_of
from kiteline_codec.schema import (
    CameraIntrinsics,
    GravityAlignment,
    KeyframeHeader,
    LivePose,
    NewLandmarks,
    Observations,
    Record,
    SubmapScale,
)
from kiteline_core.ids import (
    NO_KEYFRAME,
    SEQUENCE_BITS,
    SUBMAP_BITS,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    submap_of_keyframe,
)

# A level camera that looks along x of m: x right is -y, y down is -z, z forward is x.
_LEVEL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


class Intake:
    """The agents' records on their way into the map."""

    def __init__(self, config: IntakeConfig, sparse_map: SparseMap) -> None:
        self._config = config
        self._map = sparse_map
        self._pending: dict[
            KeyframeId, dict[tuple[bool, int], NewLandmarks | Observations]
        ] = {}  # sections before their header
        self._pending_count = 0
        self._waiting: dict[KeyframeId, int] = {}  # not used yet -> when the header came
        self._partial: set[KeyframeId] = set()  # used before they were complete
        self.live: dict[AgentId, LivePose] = {}
        self.last_of: dict[SubmapId, LivePose] = {}  # the last that was heard in each submap
        self.tracked_ns: dict[SubmapId, int] = {}  # stamp of the last pose in each submap that was no guess
        self.levels: dict[SubmapId, GravityAlignment] = {}  # what agents say of which way is up
        self.units: dict[SubmapId, float] = {}  # metres in one unit of it, as far as agents know
        self.last_seen_ns: dict[AgentId, int] = {}
        self.deleted: set[SubmapId] = set()  # of which nothing is wanted any more
        self.refused = 0  # records that contradict what is known

    def take(self, agent: AgentId, records: tuple[Record, ...], now_ns: int) -> None:
        """Put an agent's records into the map."""
        for record in records:
            self.last_seen_ns[agent] = now_ns
            if self.deleted and _submap_of(record) in self.deleted:
                continue
            if isinstance(record, CameraIntrinsics):
                self._map.set_camera(record.agent, record.camera)
            elif isinstance(record, LivePose):
                held = self.live.get(record.agent)
                if held is None or _age(record) >= _age(held):
                    self.live[record.agent] = record
                    submap = submap_of_keyframe(record.keyframe)
                    self.last_of[submap] = record
                    if record.quality > 0:
                        self.tracked_ns[submap] = record.t_ns
            elif isinstance(record, KeyframeHeader):
                self._take_head(record, now_ns)
            elif isinstance(record, GravityAlignment):
                self.levels[record.submap] = record
            elif isinstance(record, SubmapScale):
                self.units[record.submap] = record.metres
                if record.metres == 1.0:
                    self._map.metric_submaps.add(record.submap)
            elif isinstance(record, NewLandmarks | Observations):
                if record.keyframe in self._map:
                    self._take_section(record)
                elif self._pending_count < self._config.max_pending:
                    self._pending.setdefault(record.keyframe, {})[isinstance(record, NewLandmarks), record.part] = (
                        record
                    )
                    self._pending_count += 1
                else:
                    self.refused += 1

    def ready(self, now_ns: int) -> list[KeyframeId]:
        """Keyframes to be used now, in order of id: complete ones, those waited for too long, late completions."""
        self._adopt_orphans(now_ns)
        out: list[KeyframeId] = []
        patience_ns = round(self._config.patience_s * 1e9)
        for keyframe, since_ns in sorted(self._waiting.items()):
            if len(out) == self._config.per_step:
                break
            if not self._known(keyframe):
                continue
            complete = self._map.is_complete(keyframe)
            if complete or now_ns - since_ns >= patience_ns:
                out.append(keyframe)
                if not complete:
                    self._partial.add(keyframe)
        for keyframe in out:
            del self._waiting[keyframe]
        late = [k for k in sorted(self._partial) if k not in out and self._map.is_complete(k)][: self._config.per_step]
        self._partial.difference_update(late)
        return sorted(out + late)

    @property
    def backlog(self) -> bool:
        """Whether keyframes are ready that no step has taken up yet."""
        return any(self._map.is_complete(k) and self._known(k) for k in self._waiting)

    def memory(self, submap: SubmapId) -> Json:
        """What a successor cannot have from the newest values of a submap."""
        last = self.last_of.get(submap)
        told = None
        if last is not None:
            told = [int(last.agent), last.t_ns, int(last.keyframe), matrix(last.T_k_c), last.quality]
        return {"last": told, "tracked_ns": self.tracked_ns.get(submap)}

    def recall(self, submap: SubmapId, value: Json) -> None:
        """Go on from what a forerunner remembered."""
        if value["last"] is not None:
            agent, t_ns, keyframe, T_k_c, quality = value["last"]
            self.last_of[submap] = LivePose(AgentId(agent), t_ns, KeyframeId(keyframe), pose_of(T_k_c), quality)
        if value["tracked_ns"] is not None:
            self.tracked_ns[submap] = value["tracked_ns"]

    @property
    def unused(self) -> list[KeyframeId]:
        """Keyframes that no step has taken up yet, and those that were taken up in part."""
        return sorted({*self._waiting, *self._partial})

    def keep_unused(self, keyframes: Collection[KeyframeId]) -> None:
        """Take all that came for used by an earlier base, but for these."""
        self._waiting = {k: t for k, t in self._waiting.items() if k in keyframes}

    def _known(self, keyframe: KeyframeId) -> bool:
        """Whether a keyframe has a pose and a camera."""
        placed = self._map.keyframes.pose_source[self._map.rows[keyframe]] != NO_POSE
        return bool(placed) and agent_of_keyframe(keyframe) in self._map.cameras

    def _take_head(self, head: KeyframeHeader, now_ns: int) -> None:
        fresh = head.keyframe not in self._map
        try:
            self._map.add_keyframe(head.keyframe, head.t_ns, head.parent, head.T_p_k, head.keypoints)
        except ValueError:
            self.refused += 1
            return
        if fresh:
            self._waiting[head.keyframe] = now_ns
        sections = self._pending.pop(head.keyframe, {})
        self._pending_count -= len(sections)
        for _, section in sorted(sections.items(), key=lambda item: item[0]):
            self._take_section(section)

    def _take_section(self, section: NewLandmarks | Observations) -> None:
        if isinstance(section, NewLandmarks):
            self._map.put_new_landmarks(
                section.keyframe, section.part, section.index, section.uv, section.inv_depth, section.octave,
                section.angle, section.descriptor,
            )  # fmt: skip
        else:
            self._map.put_observations(
                section.keyframe, section.part, section.index, section.uv, section.inv_depth, section.octave,
                section.point,
            )  # fmt: skip

    def _adopt_orphans(self, now_ns: int) -> None:
        """Begin a submap at its oldest known keyframe when its beginning never comes (a base without store)."""
        orphan_ns = round(self._config.orphan_s * 1e9)
        late = [k for k, since_ns in self._waiting.items() if now_ns - since_ns >= orphan_ns]
        for submap in sorted({submap_of_keyframe(k) for k in late}):
            keyframes = self._map.submaps[submap]
            if all(self._map.pose(k) is None for k in keyframes):
                table, row = self._map.keyframes, self._map.rows[keyframes[0]]
                if table.parent[row] != NO_KEYFRAME:
                    self._map.set_pose(keyframes[0], _LEVEL)


def _age(live: LivePose) -> tuple[int, int]:
    """What tells the newer of two poses: an agent that started again may have a clock that did so too."""
    return live.keyframe >> SEQUENCE_BITS + SUBMAP_BITS, live.t_ns


def _submap_of(record: Record) -> SubmapId | None:
    if isinstance(record, KeyframeHeader | NewLandmarks | Observations | LivePose):
        return submap_of_keyframe(record.keyframe)
    return record.submap if isinstance(record, GravityAlignment | SubmapScale) else None

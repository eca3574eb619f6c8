"""Keeps each agent supplied with the part of the map that it is about to need: copies of keyframes that it lacks.

Which ones: those whose points stand in view from where the agent is, or will be soon, of its own map and of all that
it shares with. They are said in the submap in which the agent flies, and taken back when others are of more use.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import LoopConfig, MapCacheConfig
from kiteline_basestation.exchange.sharing import SharingPolicy
from kiteline_basestation.map.map_tables import CULLED, LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import CACHED_KINDS, CachedKeyframe, CachedLandmarks, Key, LivePose, messages
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import SUBMAP_BITS, AgentId, KeyframeId, SubmapId, agent_of_submap, submap_of_keyframe

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]


@dataclass(slots=True)
class _Lent:
    """A keyframe that an agent holds a copy of: where it was last said to be, the keys under which it went, and how
    many of the reader's units of length were one of its own.
    """

    copy: CachedKeyframe
    keys: list[Key]
    length: float


@dataclass(slots=True)
class _Reader:
    """What is remembered of an agent."""

    due_ns: int = 0
    seen_ns: int = -1  # stamp of the pose from which the last motion was taken
    submap: int = -1  # in which it flew then
    at: F64 = field(default_factory=lambda: np.zeros(3))
    velocity: F64 = field(default_factory=lambda: np.zeros(3))  # m/s in w
    lent: dict[KeyframeId, _Lent] = field(default_factory=dict)


class MapCachePlanner:
    """The windows of all agents."""

    def __init__(self, config: MapCacheConfig, loops: LoopConfig, sparse_map: SparseMap) -> None:
        self._config = config
        self._map = sparse_map
        self._sharing = SharingPolicy(loops.share)
        self._readers: dict[AgentId, _Reader] = {}

    def lent(self, agent: AgentId) -> list[KeyframeId]:
        """The keyframes of which an agent holds copies, in order of lending."""
        return list(self._readers[agent].lent) if agent in self._readers else []

    def serve(self, agent: AgentId, live: LivePose | None, channel: RecordChannel, now_ns: int) -> None:
        """Now and then, see what an agent at `live` is about to need, and share it over its channel."""
        reader = self._readers.setdefault(agent, _Reader())
        if not self._config.max_keyframes or live is None or now_ns < reader.due_ns:
            return
        here = self._map.world_pose(live.keyframe)
        if here is None or agent not in self._map.cameras:
            return
        reader.due_ns = now_ns + round(self._config.period_s * 1e9)
        here = se3.orthonormalise(here @ live.T_k_c)
        submap = submap_of_keyframe(live.keyframe)
        self._move(reader, live, submap, here)
        wanted = self._wanted(agent, reader, here, submap)
        self._take_back(reader, wanted, submap, channel)
        self._tell_moves(reader, submap, channel)
        self._lend(agent, reader, wanted, submap, channel)

    # -- inside ------------------------------------------------------------------------------------------------------

    def _move(self, reader: _Reader, live: LivePose, submap: SubmapId, here: F64) -> None:
        """How the agent moves, from two of its poses in one submap that are neither too close nor too old."""
        dt_s = (live.t_ns - reader.seen_ns) * 1e-9
        reader.velocity = np.zeros(3)
        if reader.seen_ns >= 0 and reader.submap == submap and 0.0 < dt_s <= 4.0 * self._config.period_s:
            reader.velocity = (here[:3, 3] - reader.at) / dt_s
        reader.seen_ns, reader.submap, reader.at = live.t_ns, submap, here[:3, 3].copy()

    def _wanted(self, agent: AgentId, reader: _Reader, here: F64, submap: SubmapId) -> list[KeyframeId]:
        """Keyframes that the agent lacks, those first of which it will see most."""
        rows = self._lacking(agent, submap)
        if not len(rows):
            return []
        table, keypoints = self._map.keyframes, self._map.keypoints
        ahead = here.copy()
        ahead[:3, 3] += self._config.horizon_s * reader.velocity
        reach = self._config.max_distance_ratio * self._depth_m(submap, here)
        places, axes = table.T_w_k[rows, :3, 3], table.T_w_k[rows, :3, 2]
        distance = np.minimum(
            np.linalg.norm(places - here[:3, 3], axis=1), np.linalg.norm(places - ahead[:3, 3], axis=1)
        )
        turn = axes @ here[:3, 2]
        likely = np.flatnonzero((distance < reach) & (turn > self._config.min_cosine))
        cost = distance[likely] / reach + 1.0 - turn[likely]
        rows = rows[likely[np.lexsort((table.id[rows[likely]], cost))[: self._config.max_candidates]]]
        if not len(rows):
            return []
        points = np.concatenate([self._points(KeyframeId(int(table.id[row]))) for row in rows])
        xyz, known = self._map.positions(points)
        points, xyz = points[known], xyz[known]
        seen = self._in_view(agent, here, xyz) | self._in_view(agent, ahead, xyz)
        counts = np.bincount(keypoints.row[points[seen]], minlength=len(table.id))[rows].astype(np.float64)
        held = np.array([int(k) in reader.lent for k in table.id[rows]], np.bool_)
        enough = counts >= np.where(held, 0.5, 1.0) * self._config.min_landmarks
        counts[held] *= self._config.hysteresis
        order = np.lexsort((table.id[rows], -counts))
        chosen = order[enough[order]][: self._config.max_keyframes]
        return [KeyframeId(int(k)) for k in table.id[rows[chosen]]]

    def _lacking(self, agent: AgentId, submap: SubmapId) -> NDArray[np.int64]:
        """Rows of the keyframes in the map of a submap that an agent may know and does not remember itself."""
        rows: list[int] = []
        boot = submap >> SUBMAP_BITS
        own = [s for s in self._map.submaps if s >> SUBMAP_BITS == boot]
        newest = sorted(
            (int(self._map.keyframes.t_ns[self._map.rows[k]]), k)
            for s in own
            for k in self._map.submaps[s][-self._config.local_keyframes :]
        )
        remembered = {k for _, k in newest[-self._config.local_keyframes :]}
        for other in self._map.submaps_of_map(submap):
            if self._sharing.allows(agent, agent_of_submap(other)):
                rows += [self._map.rows[k] for k in self._map.submaps.get(other, []) if k not in remembered]
        return np.array([r for r in rows if self._map.keyframes.pose_source[r]], np.int64)

    def _depth_m(self, submap: SubmapId, here: F64) -> float:
        """How far the points of the agent's newest keyframes are, roughly."""
        slots = np.concatenate([self._map.slots_of(k) for k in self._map.submaps[submap][-3:]])
        inverse = self._map.inverse_depths(slots) / self._map.scale(submap)
        inverse = inverse[inverse > 0.0]
        return 1.0 / float(np.median(inverse)) if len(inverse) else 1.0

    def _points(self, keyframe: KeyframeId) -> I32:
        """The points that hang on a keyframe and can be found again: live ones with a depth and a descriptor."""
        slots, table = self._map.slots_of(keyframe), self._map.keypoints
        live = (table.kind[slots] == LANDMARK) & (table.root[slots] == slots) & (table.flags[slots] & CULLED == 0)
        live &= (self._map.inverse_depths(slots) > 0.0) & table.descriptor[slots].any(axis=1)
        return np.asarray(slots[live])

    def _in_view(self, agent: AgentId, T_w_c: F64, xyz: F64) -> NDArray[np.bool_]:
        camera = self._map.cameras[agent]
        local = (xyz - T_w_c[:3, 3]) @ T_w_c[:3, :3]
        z = np.maximum(local[:, 2], 1e-3)
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        inside = (u >= 0.0) & (v >= 0.0) & (u < camera.width) & (v < camera.height)
        return np.asarray(inside & (local[:, 2] > 0.1))

    def _take_back(
        self, reader: _Reader, wanted: list[KeyframeId], submap: SubmapId, channel: RecordChannel
    ) -> None:  # fmt: skip
        """What is no longer of one map with the submap in which it was lent, or no longer wanted before it arrived;
        then, for want of room, what is not wanted, the oldest first.
        """
        map_id = self._map.map_id
        gone = [
            k
            for k, lent in reader.lent.items()
            if map_id(submap_of_keyframe(k)) != map_id(lent.copy.submap)
            or abs(self._length(k, submap) / lent.length - 1.0) > self._config.max_scale_change
            or (k not in wanted and not _arrived(lent, channel))
        ]
        new = sum(k not in reader.lent for k in wanted)
        idle = [k for k in reader.lent if k not in wanted and k not in gone]
        spare = self._config.max_keyframes - len(reader.lent) + len(gone)
        gone += idle[: max(0, min(new, channel.profile.cached_ahead) - spare)]
        for keyframe in gone:
            for key in reader.lent.pop(keyframe).keys:
                channel.remove(key)

    def _tell_moves(self, reader: _Reader, submap: SubmapId, channel: RecordChannel) -> None:
        """Copies stand where the map has them now, said in the submap in which the agent flies now."""
        for keyframe, lent in reader.lent.items():
            if self._map.map_id(submap_of_keyframe(keyframe)) != self._map.map_id(submap):
                continue
            now = self._copy(keyframe, submap)
            if lent.copy.submap == submap:
                change = se3.inverse(lent.copy.T_m_k) @ now.T_m_k
                moved, turned = np.linalg.norm(change[:3, 3]), np.linalg.norm(change[:3, :3] - np.eye(3)) / np.sqrt(2.0)
                if moved <= self._config.pose_m and turned <= self._config.pose_rad:
                    continue
            channel.put(now)
            lent.copy = now

    def _lend(
        self, agent: AgentId, reader: _Reader, wanted: list[KeyframeId], submap: SubmapId, channel: RecordChannel
    ) -> None:  # fmt: skip
        """The best of what is wanted, as far as there is room here and on the link."""
        ahead = channel.profile.cached_ahead - sum(not _arrived(lent, channel) for lent in reader.lent.values())
        room = self._config.max_keyframes - len(reader.lent)
        for keyframe in [k for k in wanted if k not in reader.lent][: max(0, min(ahead, room))]:
            copy = self._copy(keyframe, submap)
            points, strength = self._copied(agent, keyframe, self._length(keyframe, submap))
            records: list[CachedKeyframe | CachedLandmarks] = [copy, *channel.profile.cached_sections(points, strength)]
            for record in records:
                channel.put(record)
            keys = [messages.key(record) for record in records]
            reader.lent[keyframe] = _Lent(copy, keys, self._length(keyframe, submap))

    def _copy(self, keyframe: KeyframeId, submap: SubmapId) -> CachedKeyframe:
        T_w_k = self._map.world_pose(keyframe)
        assert T_w_k is not None
        return CachedKeyframe(
            keyframe, submap, se3.orthonormalise(sim3.place(sim3.inverse(self._map.submap_pose(submap)), T_w_k))
        )

    def _length(self, keyframe: KeyframeId, submap: SubmapId) -> float:
        """How many units of a submap one of a keyframe's is."""
        return self._map.scale(submap_of_keyframe(keyframe)) / self._map.scale(submap)

    def _copied(self, agent: AgentId, keyframe: KeyframeId, length: float) -> tuple[CachedLandmarks, F64]:
        """A keyframe's points as the reader's camera would see them, its lengths so many times as long, and how often
        each was seen.
        """
        points, table = self._points(keyframe), self._map.keypoints
        fx, fy, cx, cy = self._map.keyframes.camera[self._map.rows[keyframe], :4]
        camera = self._map.cameras[agent]
        at = (table.uv[points] + table.offset[points] - (cx, cy)) / (fx, fy)
        uv = at * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        inside = (uv > -60.0).all(axis=1) & (uv < 4000.0).all(axis=1)  # what the code holds
        points, uv = points[inside], uv[inside]
        starts, _ = self._map.observations(points)
        points_seen = np.diff(starts).astype(np.float64)
        return CachedLandmarks(
            keyframe,
            0,
            self._map.keypoint_of(points).astype(np.uint16),
            uv.astype(np.float32),
            (self._map.inverse_depths(points) / length).astype(np.float32),
            table.octave[points].copy(),
            table.angle[points].copy(),
            table.descriptor[points].copy(),
        ), points_seen


def _arrived(lent: _Lent, channel: RecordChannel) -> bool:
    return all(channel.arrived(key) for key in lent.keys)


def is_copy(key: Key) -> bool:
    """Whether a key is one of a copy: those are lent anew by each base."""
    return key.kind in CACHED_KINDS

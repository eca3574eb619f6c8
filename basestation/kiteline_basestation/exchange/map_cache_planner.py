"""Plans each agent's map cache: which keyframes that it lacks it will need soon.

Candidates are keyframes of its map, of agents that share with it, whose landmarks are in view from the agent's pose
now or after a short prediction. They are sent in the frame of the submap that the agent is in, and removed again when
others are needed more.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from kiteline_basestation.config import LoopConfig, MapCachePlannerConfig
from kiteline_basestation.exchange.agent_velocity import AgentVelocity
from kiteline_basestation.exchange.sharing import SharingPolicy
from kiteline_basestation.map.map_tables import CULLED, LANDMARK, NO_POSE
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.map.world_poses import is_near
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import CACHED_KINDS, CachedKeyframe, CachedLandmarks, GridTile, Key, LivePose, messages
from kiteline_core.arrays import F64, I32, Bool
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import SUBMAP_BITS, AgentId, KeyframeId, SubmapId, agent_of_keyframe, submap_of_keyframe
from kiteline_core.imaging.descriptors import is_described

_MAX_CANDIDATES = 60  # keyframes whose landmarks are projected
_MIN_LANDMARKS = 8  # landmarks of a keyframe that will be in view: fewer are not worth their bytes
_HYSTERESIS = 1.5  # factor on the landmarks in view of a keyframe that is cached already
_POSE_M = 0.002  # m; smaller corrections of a cached keyframe are not sent: half a pixel at 2 m
_POSE_RAD = 0.0005  # rad; a quarter of a pixel at 500 px of focal length
_MAX_SCALE_CHANGE = 0.01  # relative change of the agent's unit of length at which keyframes are sent again
_PERIOD_S = 1.0  # s between two plans


@dataclass(slots=True)
class _Cached:
    """A keyframe in an agent's cache. scale: its unit of length in units of the submap for which it was sent."""

    record: CachedKeyframe
    keys: list[Key]
    scale: float


@dataclass(slots=True)
class _AgentCache:
    """State of one agent's cache."""

    velocity: AgentVelocity
    due_ns: int = 0  # time of the next plan
    cached: dict[KeyframeId, _Cached] = field(default_factory=dict)  # in order of sending


class MapCachePlanner:
    """The map caches of all agents."""

    def __init__(self, config: MapCachePlannerConfig, loops: LoopConfig, sparse_map: SparseMap) -> None:
        self._config = config
        self._map = sparse_map
        self._sharing = SharingPolicy(loops.share)
        self._caches: dict[AgentId, _AgentCache] = {}

    def cached(self, agent: AgentId) -> list[KeyframeId]:
        """The keyframes in an agent's cache, in order of sending."""
        return list(self._caches[agent].cached) if agent in self._caches else []

    def update(self, agent: AgentId, live: LivePose | None, channel: RecordChannel, now_ns: int) -> None:
        """Plan the cache of an agent at `live` once a period, and send the changes over its channel."""
        cache = self._caches.setdefault(agent, _AgentCache(AgentVelocity(_PERIOD_S)))
        if not self._config.max_keyframes or live is None or now_ns < cache.due_ns:
            return
        T_w_k = self._map.world_pose(live.keyframe)
        if T_w_k is None or agent not in self._map.cameras:
            return
        cache.due_ns = now_ns + round(_PERIOD_S * 1e9)
        T_w_c = se3.orthonormalise(T_w_k @ live.T_k_c)
        submap = submap_of_keyframe(live.keyframe)
        predicted = T_w_c.copy()
        predicted[:3, 3] += self._config.horizon_s * cache.velocity.update(live.t_ns, submap, T_w_c[:3, 3])
        needed = self._needed(agent, cache, T_w_c, predicted, submap)
        self._remove(cache, needed, submap, channel)
        self._send_moved(cache, submap, channel)
        self._send_new(agent, cache, needed, submap, channel)

    # -- inside ------------------------------------------------------------------------------------------------------

    def _needed(
        self, agent: AgentId, cache: _AgentCache, T_w_c: F64, predicted: F64, submap: SubmapId
    ) -> list[KeyframeId]:  # fmt: skip
        """Keyframes that the agent lacks, those with most landmarks in view first. predicted: T_w_c (4,4) soon."""
        reach = self._config.max_distance_ratio * self._depth_m(submap)
        rows = self._lacking(agent, submap, (T_w_c[:3, 3], predicted[:3, 3]), reach)
        if not len(rows):
            return []
        table, keypoints = self._map.keyframes, self._map.keypoints
        positions, axes = table.T_w_k[rows, :3, 3], table.T_w_k[rows, :3, 2]
        distance = np.minimum(
            np.linalg.norm(positions - T_w_c[:3, 3], axis=1), np.linalg.norm(positions - predicted[:3, 3], axis=1)
        )
        cosine = axes @ T_w_c[:3, 2]
        likely = np.flatnonzero((distance < reach) & (cosine > self._config.min_cosine))
        cost = distance[likely] / reach + 1.0 - cosine[likely]
        rows = rows[likely[np.lexsort((table.id[rows[likely]], cost))[:_MAX_CANDIDATES]]]
        if not len(rows):
            return []
        landmarks = np.concatenate([self._landmarks(KeyframeId(int(table.id[row]))) for row in rows])
        xyz, known = self._map.positions(landmarks)
        landmarks, xyz = landmarks[known], xyz[known]
        visible = self._in_view(agent, T_w_c, xyz) | self._in_view(agent, predicted, xyz)
        counts = np.bincount(keypoints.row[landmarks[visible]], minlength=len(table.id))[rows].astype(np.float64)
        held = np.array([int(k) in cache.cached for k in table.id[rows]], np.bool_)
        enough = counts >= np.where(held, 0.5, 1.0) * _MIN_LANDMARKS
        counts[held] *= _HYSTERESIS
        order = np.lexsort((table.id[rows], -counts))
        chosen = order[enough[order]][: self._config.max_keyframes]
        return [KeyframeId(int(k)) for k in table.id[rows[chosen]]]

    def _lacking(self, agent: AgentId, submap: SubmapId, centres: Sequence[F64], reach: float) -> I32:
        """Rows of keyframes of the map, near one of the centres (3,) in w, that are shared with the agent and not in
        its local map.
        """
        table, newest = self._map.keyframes, self._config.local_keyframes
        boot = submap >> SUBMAP_BITS
        own = np.concatenate([self._map.rows_of(s)[-newest:] for s in self._map.submaps if s >> SUBMAP_BITS == boot])
        local = own[np.lexsort((table.id[own], table.t_ns[own]))][-newest:]
        rows = np.unique(np.concatenate([self._map.rows_near(submap, centre, reach) for centre in centres]))
        rows = rows[(table.pose_source[rows] != NO_POSE) & ~np.isin(rows, local)]
        shared = [self._sharing.allows(agent, agent_of_keyframe(KeyframeId(k))) for k in table.id[rows].tolist()]
        return np.asarray(rows[np.array(shared, np.bool_)])

    def _depth_m(self, submap: SubmapId) -> float:
        """Median depth in w of the landmarks of the agent's newest keyframes."""
        slots = np.concatenate([self._map.slots_of(k) for k in self._map.submaps[submap][-3:]])
        inverse = self._map.inverse_depths(slots) / self._map.scale(submap)
        inverse = inverse[inverse > 0.0]
        return 1.0 / float(np.median(inverse)) if len(inverse) else 1.0

    def _landmarks(self, keyframe: KeyframeId) -> I32:
        """Root landmarks anchored in a keyframe that have a depth and a descriptor."""
        slots, table = self._map.slots_of(keyframe), self._map.keypoints
        live = (table.kind[slots] == LANDMARK) & (table.root[slots] == slots) & (table.flags[slots] & CULLED == 0)
        live &= (self._map.inverse_depths(slots) > 0.0) & is_described(table.descriptor[slots])
        return np.asarray(slots[live])

    def _in_view(self, agent: AgentId, T_w_c: F64, xyz: F64) -> Bool:
        camera = self._map.cameras[agent]
        local = (xyz - T_w_c[:3, 3]) @ T_w_c[:3, :3]
        z = np.maximum(local[:, 2], 1e-3)
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        inside = (u >= 0.0) & (v >= 0.0) & (u < camera.width) & (v < camera.height)
        return np.asarray(inside & (local[:, 2] > 0.1))

    def _remove(
        self, cache: _AgentCache, needed: list[KeyframeId], submap: SubmapId, channel: RecordChannel
    ) -> None:  # fmt: skip
        """Remove keyframes of another map or scale, those not needed before they arrived, and the oldest for room."""
        map_id = self._map.map_id
        gone = [
            k
            for k, entry in cache.cached.items()
            if k not in self._map
            or map_id(submap_of_keyframe(k)) != map_id(entry.record.submap)
            or abs(self._scale(k, submap) / entry.scale - 1.0) > _MAX_SCALE_CHANGE
            or (k not in needed and not _arrived(entry, channel))
        ]
        new = sum(k not in cache.cached for k in needed)
        idle = [k for k in cache.cached if k not in needed and k not in gone]
        spare = self._config.max_keyframes - len(cache.cached) + len(gone)
        gone += idle[: max(0, min(new, channel.profile.cached_ahead) - spare)]
        for keyframe in gone:
            for key in cache.cached.pop(keyframe).keys:
                channel.remove(key)

    def _send_moved(self, cache: _AgentCache, submap: SubmapId, channel: RecordChannel) -> None:
        """Send new poses of cached keyframes that moved, or are in the frame of another submap than the agent's."""
        for keyframe, entry in cache.cached.items():
            if self._map.map_id(submap_of_keyframe(keyframe)) != self._map.map_id(submap):
                continue
            now = self._record(keyframe, submap)
            if not is_near(now.T_m_k):
                continue
            if entry.record.submap == submap:
                change = se3.inverse(entry.record.T_m_k) @ now.T_m_k
                moved, turned = np.linalg.norm(change[:3, 3]), np.linalg.norm(change[:3, :3] - np.eye(3)) / np.sqrt(2.0)
                if moved <= _POSE_M and turned <= _POSE_RAD:
                    continue
            channel.put(now)
            entry.record = now

    def _send_new(
        self, agent: AgentId, cache: _AgentCache, needed: list[KeyframeId], submap: SubmapId, channel: RecordChannel
    ) -> None:  # fmt: skip
        """Send the most needed keyframes, as far as the cache and the link have room."""
        ahead = channel.profile.cached_ahead - sum(not _arrived(entry, channel) for entry in cache.cached.values())
        room = self._config.max_keyframes - len(cache.cached)
        for keyframe in [k for k in needed if k not in cache.cached][: max(0, min(ahead, room))]:
            record, scale = self._record(keyframe, submap), self._scale(keyframe, submap)
            if not is_near(record.T_m_k):
                continue
            landmarks, views = self._landmarks_record(agent, keyframe, scale)
            records: list[CachedKeyframe | CachedLandmarks] = [
                record, *channel.profile.cached_sections(landmarks, views)
            ]  # fmt: skip
            for r in records:
                channel.put(r)
            cache.cached[keyframe] = _Cached(record, [messages.key(r) for r in records], scale)

    def _record(self, keyframe: KeyframeId, submap: SubmapId) -> CachedKeyframe:
        """A keyframe with its pose in a submap."""
        T_w_k = self._map.world_pose(keyframe)
        assert T_w_k is not None
        T_m_k = se3.orthonormalise(sim3.place(sim3.inverse(self._map.submap_pose(submap)), T_w_k))
        return CachedKeyframe(keyframe, submap, T_m_k)

    def _scale(self, keyframe: KeyframeId, submap: SubmapId) -> float:
        """Unit of length of a keyframe in units of a submap."""
        return self._map.scale(submap_of_keyframe(keyframe)) / self._map.scale(submap)

    def _landmarks_record(self, agent: AgentId, keyframe: KeyframeId, scale: float) -> tuple[CachedLandmarks, F64]:
        """Landmarks of a keyframe as the agent's camera would see them, and their numbers of observations (n,).

        scale: factor on lengths.
        """
        landmarks, table = self._landmarks(keyframe), self._map.keypoints
        fx, fy, cx, cy = self._map.keyframes.camera[self._map.rows[keyframe], :4]
        camera = self._map.cameras[agent]
        bearing = (table.uv[landmarks] + table.offset[landmarks] - (cx, cy)) / (fx, fy)
        uv = bearing * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        codable = (uv > -60.0).all(axis=1) & (uv < 4000.0).all(axis=1)  # range of the code
        landmarks, uv = landmarks[codable], uv[codable]
        starts, _ = self._map.observations(landmarks)
        return CachedLandmarks(
            keyframe,
            0,
            self._map.keypoint_of(landmarks).astype(np.uint16),
            uv.astype(np.float32),
            (self._map.inverse_depths(landmarks) / scale).astype(np.float32),
            table.octave[landmarks].copy(),
            table.angle[landmarks].copy(),
            table.descriptor[landmarks].copy(),
        ), np.diff(starts).astype(np.float64)


def _arrived(entry: _Cached, channel: RecordChannel) -> bool:
    return all(channel.arrived(key) for key in entry.keys)


def is_cached_key(key: Key) -> bool:
    """True for keys of cached keyframes and grid tiles, which each base process sends anew."""
    return key.kind in CACHED_KINDS or key.kind == GridTile.KIND

"""The sparse map as it stands: its tables, and what can be asked of them. `sparse_map` says what changes it."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.map import sparse_map_kernels as kernels
from kiteline_basestation.map.map_tables import (
    CULLED,
    LANDMARK,
    NO_POSE,
    REFINED,
    KeyframeTable,
    KeypointTable,
    empty_keyframes,
    empty_keypoints,
)
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import KEYPOINT_BITS, MAX_KEYPOINTS, AgentId, KeyframeId, SubmapId, agent_of_submap

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]


class MapView:
    """Keyframes, keypoints and points of any number of agents and submaps."""

    def __init__(self) -> None:
        self.keyframes = empty_keyframes()
        self.keypoints = empty_keypoints()
        self.slots = 0
        self.rows: dict[KeyframeId, int] = {}
        self.submaps: dict[SubmapId, list[KeyframeId]] = {}  # keyframes of each submap in order of id
        self.submap_poses: dict[
            SubmapId, F64
        ] = {}  # S_w_m of each submap that does not lie as it was begun: a similarity
        self._scales: dict[SubmapId, float] = {}  # the scales of these
        self.root_submaps: dict[SubmapId, SubmapId] = {}  # submaps joined to others -> the eldest of them
        self.cameras: dict[AgentId, RectifiedCamera] = {}
        self.metric_submaps: set[SubmapId] = set()  # of one eye, whose agent knows the metre
        self.measures_depth: set[AgentId] = set()  # agents whose sightings have depth of their own (stereo, RGB-D)
        self.disparity_offset_px: dict[AgentId, F64] = {}  # what an agent's disparities are too large by, see the base
        self.disparity_calibrated: set[AgentId] = set()  # agents whose offset is known well
        self._children: dict[KeyframeId, list[int]] = {}
        self._waiting: dict[KeyframeId, list[int]] = {}  # slots that name a point of a keyframe that is not here yet

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self.rows)

    def __contains__(self, keyframe: KeyframeId) -> bool:
        return keyframe in self.rows

    def slots_of(self, keyframe: KeyframeId) -> I32:
        """All slots of a keyframe, in order of keypoint index."""
        row = self.rows[keyframe]
        start = int(self.keyframes.start[row])
        return np.arange(start, start + int(self.keyframes.count[row]), dtype=np.int32)

    def keypoint_of(self, slots: I32) -> I32:
        """Keypoint indices within their keyframes."""
        return np.asarray(slots - self.keyframes.start[self.keypoints.row[slots]], np.int32)

    def landmark_ids(self, slots: I32) -> I64:
        """Ids (n,) of the points born at slots (n,)."""
        anchors = self.keyframes.id[self.keypoints.row[slots]]
        return np.asarray((anchors << KEYPOINT_BITS) | self.keypoint_of(slots), np.int64)

    def find_landmarks(self, points: I64) -> I32:
        """Slots (n,) of the births of points (n,), -1 where the keyframe is unknown or has no such keypoint."""
        anchors, which = np.unique(points >> KEYPOINT_BITS, return_inverse=True)
        rows = np.array([self.rows.get(KeyframeId(a), -1) for a in anchors.tolist()], np.int64)[which]
        index = points & (MAX_KEYPOINTS - 1)
        known = (rows >= 0) & (points >= 0)
        known[known] = index[known] < self.keyframes.count[rows[known]]
        out = np.full(len(points), -1, np.int32)
        out[known] = self.keyframes.start[rows[known]] + index[known]
        return out

    def observations_of(self, keyframe: KeyframeId) -> I32:
        """Slots of a keyframe's valid observations whose point is known and not culled."""
        slots = self.slots_of(keyframe)
        return np.asarray(slots[self._counts(slots)])

    def landmarks_of(self, keyframe: KeyframeId) -> I32:
        """Slots of the points that a keyframe observes, in order of id."""
        return self.sorted_by_id(self.keypoints.root[self.observations_of(keyframe)])

    def sorted_by_id(self, points: I32) -> I32:
        """Points without repetition in order of id: an order that does not tell what arrived first."""
        points = np.unique(points)
        return np.asarray(points[np.argsort(self.landmark_ids(points))])

    def live_landmarks(self) -> I32:
        """Slots of all points that live, in order of id: born, not fused into another, not culled."""
        table = self.keypoints
        n = self.slots
        here = np.arange(n, dtype=np.int32)
        live = (table.kind[:n] == LANDMARK) & (table.root[:n] == here) & (table.flags[:n] & CULLED == 0)
        return self.sorted_by_id(here[live])

    def observations(self, points: I32) -> tuple[I32, I32]:
        """Valid observations of points (n,), in order of keyframe id, one a keyframe.

        Returns starts (n + 1,) and slots: those of points[i] are slots[starts[i]:starts[i + 1]].
        """
        table = self.keypoints
        starts = np.empty(len(points) + 1, np.int32)
        slots = np.empty(kernels.count(points, table.first, table.next), np.int32)
        n = kernels.gather(
            points, table.first, table.next, table.row, table.usable, self.keyframes.id, starts, slots
        )  # fmt: skip
        return starts, slots[:n]

    def covisibility(self, points: I32) -> I32:
        """How many of the points (n,) each keyframe (by row) observes."""
        shared = np.zeros(len(self), np.int32)
        table = self.keypoints
        kernels.covisibility(points, table.first, table.next, table.row, table.usable, shared)
        return shared

    def covisible_keyframes(self, keyframe: KeyframeId, min_shared: int) -> list[KeyframeId]:
        """Keyframes of the same map that share at least min_shared landmarks, most first, newer first among equals."""
        shared = self.covisibility(self.landmarks_of(keyframe))
        rows = np.flatnonzero(shared >= max(min_shared, 1))
        ids = self.keyframes.id[rows]
        order = np.lexsort((-ids, -shared[rows]))
        return [k for k in map(KeyframeId, ids[order].tolist()) if k != keyframe]

    def observed_together(self, a: int, b: int) -> bool:
        """Whether some keyframe observes both points: then they cannot be one."""
        table = self.keypoints
        return bool(kernels.share_keyframe(a, b, table.first, table.next, table.row, table.usable))

    def inverse_depths(self, points: I32) -> F64:
        """Inverse depth (n,) in 1/m of points in their anchors: refined, else as seen; 0 unknown. A metre is the unit
        of the anchor's submap.
        """
        table = self.keypoints
        refined = table.flags[points] & REFINED != 0
        return np.where(refined, table.refined[points], table.inv_depth[points]).astype(np.float64)

    def positions(self, points: I32) -> tuple[F64, Bool]:
        """Positions (n,3) in m in the frame w in which the submaps lie, and whether each is known."""
        table = self.keypoints
        rows = table.row[points]
        inv = self.inverse_depths(points)
        valid = (inv > 0) & (self.keyframes.pose_source[rows] != NO_POSE) & (table.kind[points] == LANDMARK)
        z = self.keyframes.unit[rows] / np.where(valid, inv, 1.0)  # in units of w
        fx, fy, cx, cy = self.keyframes.camera[rows, :4].T
        uv = table.uv[points].astype(np.float64) + table.offset[points]
        local = np.stack(
            [(uv[:, 0] - cx) / np.where(fx > 0, fx, 1.0) * z, (uv[:, 1] - cy) / np.where(fy > 0, fy, 1.0) * z, z], 1
        )
        pose = self.keyframes.T_w_k[rows]
        return np.einsum("nij,nj->ni", pose[:, :3, :3], local) + pose[:, :3, 3], valid & (fx > 0)

    def project_into_anchor(self, points: I32, positions: F64) -> tuple[F32, F32, Bool]:
        """The inverse of `positions`: inverse depths (n,), offsets (n,2) px, whether each lies before its anchor."""
        rows = self.keypoints.row[points]
        pose = self.keyframes.T_w_k[rows]
        local = np.einsum("nji,nj->ni", pose[:, :3, :3], positions - pose[:, :3, 3])
        ahead = local[:, 2] > 1e-3
        inv = 1.0 / np.where(ahead, local[:, 2], 1.0)
        fx, fy, cx, cy = self.keyframes.camera[rows, :4].T
        u, v = fx * local[:, 0] * inv + cx, fy * local[:, 1] * inv + cy
        offset = np.stack([u, v], 1) - self.keypoints.uv[points]
        return (inv * self.keyframes.unit[rows]).astype(np.float32), offset.astype(np.float32), ahead

    def pose(self, keyframe: KeyframeId) -> F64 | None:
        """T_m_k (4,4) of a keyframe, or None when it is unknown or its parents are missing."""
        row = self.rows.get(keyframe)
        if row is None or self.keyframes.pose_source[row] == NO_POSE:
            return None
        return np.asarray(self.keyframes.T_m_k[row]).copy()

    def world_pose(self, keyframe: KeyframeId) -> F64 | None:
        """T_w_k (4,4) of a keyframe, or None as with `pose`."""
        row = self.rows.get(keyframe)
        if row is None or self.keyframes.pose_source[row] == NO_POSE:
            return None
        return np.asarray(self.keyframes.T_w_k[row]).copy()

    def submap_pose(self, submap: SubmapId) -> F64:
        """S_w_m (4,4) of a submap: a rigid motion, or a similarity where its unit of length is not that of w."""
        held = self.submap_poses.get(submap)
        return np.eye(4) if held is None else held.copy()

    def scale(self, submap: SubmapId) -> float:
        """How many units of w one of a submap is."""
        return self._scales.get(submap, 1.0)

    def is_up_to_scale(self, submap: SubmapId) -> bool:
        """Whether a submap's unit of length is its own: one eye saw it, that knows no metre."""
        agent = agent_of_submap(submap)
        camera = self.cameras.get(agent)
        deep = camera is None or camera.stereo or agent in self.measures_depth
        return not (deep or submap in self.metric_submaps)

    def map_id(self, submap: SubmapId) -> SubmapId:
        """The eldest of the submaps that are one map with this one."""
        return self.root_submaps.get(submap, submap)

    def submaps_of_map(self, submap: SubmapId) -> list[SubmapId]:
        """All submaps that are one map with this one, in order of id."""
        eldest = self.map_id(submap)
        return sorted({eldest} | {s for s, root in self.root_submaps.items() if root == eldest})

    def is_complete(self, keyframe: KeyframeId) -> bool:
        """Whether all keypoints that the header announced have arrived."""
        row = self.rows[keyframe]
        return bool(self.keyframes.filled[row] >= self.keyframes.count[row])

    def nbytes(self) -> int:
        """Bytes of all arrays, spare capacity included."""
        tables: tuple[KeyframeTable | KeypointTable, ...] = (self.keyframes, self.keypoints)
        return sum(getattr(t, f.name).nbytes for t in tables for f in fields(t))

    def _counts(self, slots: I32) -> Bool:
        table = self.keypoints
        root = table.root[slots]
        alive = (table.usable[slots] != 0) & (root >= 0)
        alive[alive] = (table.flags[root[alive]] & CULLED == 0) & (table.kind[root[alive]] == LANDMARK)
        return np.asarray(alive)

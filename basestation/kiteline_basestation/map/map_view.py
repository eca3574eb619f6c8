"""Queries of the sparse map; `sparse_map` holds what changes it."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from kiteline_basestation.map import sparse_map_kernels as kernels
from kiteline_basestation.map.free_runs import FreeRuns
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
from kiteline_codec.schema import InertialSteps
from kiteline_core.arrays import F32, F64, I32, I64, Bool
from kiteline_core.geometry import disparity_offset
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import (
    KEYPOINT_BITS,
    MAX_KEYPOINTS,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_submap,
    submap_of_keyframe,
)


class Rows:
    """Rows of a submap's keyframes in order of id, in an array that grows."""

    def __init__(self) -> None:
        self._held = np.empty(16, np.int32)
        self._count = 0

    def insert(self, at: int, row: int) -> None:
        """Insert a row at a position."""
        if self._count == len(self._held):
            self._held = np.concatenate([self._held, np.empty(len(self._held) // 2, np.int32)])
        self._held[at + 1 : self._count + 1] = self._held[at : self._count]
        self._held[at] = row
        self._count += 1

    @property
    def rows(self) -> I32:
        """All rows; a view."""
        return self._held[: self._count]


class MapView:
    """Read access to keyframes, keypoints and landmarks of all agents. Landmarks are named by their slots."""

    def __init__(self) -> None:
        self.keyframes = empty_keyframes()
        self.keypoints = empty_keypoints()
        self.height = 0  # rows of keyframes in use, or free for the next ones
        self.slots = 0  # the same of keypoints
        self._free_rows, self._free_slots = FreeRuns(), FreeRuns()
        self.rows: dict[KeyframeId, int] = {}
        self.submaps: dict[SubmapId, list[KeyframeId]] = {}  # keyframes by submap, in order of id
        self._rows_of: dict[SubmapId, Rows] = {}  # of the same keyframes
        self.keypoints_of: dict[SubmapId, int] = {}  # number of keypoints by submap that have arrived
        self.submap_poses: dict[SubmapId, F64] = {}  # S_w_m (4,4) similarity by submap, where not the identity
        self._scales: dict[SubmapId, float] = {}  # of `submap_poses`
        self.root_submaps: dict[SubmapId, SubmapId] = {}  # merged submaps -> root submap of their map
        self.cameras: dict[AgentId, RectifiedCamera] = {}
        self.metric_submaps: set[SubmapId] = set()  # monocular submaps of known metric scale
        self.scaled_submaps: set[SubmapId] = set()  # of these, those with lengths that the base corrected by the IMU
        self.inertial_steps: dict[KeyframeId, InertialSteps] = {}  # from the keyframe before to this one
        # Unit vector (3,) against gravity in the keyframe's camera, and its deviation in rad.
        self.up: dict[KeyframeId, tuple[F64, float]] = {}
        self.metres_per_unit: dict[SubmapId, float] = {}  # of monocular submaps, as far as their agents know it
        self.measures_depth: set[AgentId] = set()  # agents that measure depth in each observation (stereo, RGB-D)
        self.disparity_offset_px: dict[AgentId, F64] = {}  # (5,) by agent, see disparity_calibration
        self.disparity_calibrated: set[AgentId] = set()  # agents with an accurate disparity offset
        self.disparity_sigma_px: dict[AgentId, float] = {}  # its deviation, rms over the image, if the rig is worn
        self.known_offset_px: dict[AgentId, F64] = {}  # (5,) by agent: that of earlier flights, or found on board
        self.good_offset_px: dict[AgentId, F64] = {}  # (5,) by agent: a good calibration's, found on board
        self.onboard_sigma_px: dict[AgentId, float] = {}  # deviation of a known offset that was found on board
        self.measured_with_px: dict[
            KeyframeId, F64
        ] = {}  # (5,) offset that motion was measured with, where it changed in a submap
        self.rows_px: dict[AgentId, F64] = {}  # (5,) by agent: how far the right image lies off its rows
        self.rows_read: set[AgentId] = set()  # agents that read the right image there
        self.moved_rows: set[int] = set()  # keyframes whose pose changed, by row, since a reader cleared it
        self._children: dict[KeyframeId, list[int]] = {}
        self._waiting: dict[KeyframeId, dict[int, None]] = {}  # slots whose landmark's keyframe is not received yet

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self.rows)

    def __contains__(self, keyframe: KeyframeId) -> bool:
        return keyframe in self.rows

    def rows_of(self, submap: SubmapId) -> I32:
        """Rows of all keyframes of a submap, in order of id; a view that the next keyframe changes."""
        held = self._rows_of.get(submap)
        return np.empty(0, np.int32) if held is None else held.rows

    def rows_of_map(self, submap: SubmapId) -> I32:
        """Rows of all keyframes of the map that a submap belongs to, in order of id."""
        return np.concatenate([self.rows_of(s) for s in self.submaps_of_map(submap)])

    def rows_near(self, submap: SubmapId, position: F64, reach: float) -> I32:
        """Rows of keyframes, of the map that a submap belongs to, which may lie within `reach` of (3,) in w."""
        out = []
        for other in self.submaps_of_map(submap):
            rows = self.rows_of(other)
            near = np.empty(len(rows), np.int32)
            count = kernels.rows_near(rows, self.keyframes.T_w_k, np.array(position), reach, near)
            out.append(near[:count])
        return np.concatenate(out)

    def number_of(self, keyframe: KeyframeId) -> int:
        """How many keyframes of its submap are older than a known keyframe."""
        return bisect_left(self.submaps[submap_of_keyframe(keyframe)], keyframe)

    def children_of(self, keyframe: KeyframeId) -> list[int]:
        """Rows of the keyframes whose parent is this one."""
        return self._children.get(keyframe, [])

    def slots_of(self, keyframe: KeyframeId) -> I32:
        """Slots of all keypoints of a keyframe, in order of keypoint index."""
        row = self.rows[keyframe]
        start = int(self.keyframes.start[row])
        return np.arange(start, start + int(self.keyframes.count[row]), dtype=np.int32)

    def keypoint_of(self, slots: I32) -> I32:
        """Keypoint indices within their keyframes."""
        return np.asarray(slots - self.keyframes.start[self.keypoints.row[slots]], np.int32)

    def landmark_ids(self, slots: I32) -> I64:
        """Ids (n,) of the landmarks at slots (n,)."""
        anchors = self.keyframes.id[self.keypoints.row[slots]]
        return np.asarray((anchors << KEYPOINT_BITS) | self.keypoint_of(slots), np.int64)

    def find_landmarks(self, ids: I64) -> I32:
        """Slots (n,) of landmarks by id (n,), -1 if the keyframe is unknown or has no such keypoint."""
        anchors, which = np.unique(ids >> KEYPOINT_BITS, return_inverse=True)
        rows = np.array([self.rows.get(KeyframeId(a), -1) for a in anchors.tolist()], np.int64)[which]
        index = ids & (MAX_KEYPOINTS - 1)
        known = (rows >= 0) & (ids >= 0)
        known[known] = index[known] < self.keyframes.count[rows[known]]
        out = np.full(len(ids), -1, np.int32)
        out[known] = self.keyframes.start[rows[known]] + index[known]
        return out

    def observations_of(self, keyframe: KeyframeId) -> I32:
        """Slots of a keyframe's valid observations of landmarks that are known and not culled."""
        slots = self.slots_of(keyframe)
        return np.asarray(slots[self._is_valid(slots)])

    def landmarks_of(self, keyframe: KeyframeId) -> I32:
        """Slots of the landmarks that a keyframe observes, in order of id."""
        return self.sorted_by_id(self.keypoints.root[self.observations_of(keyframe)])

    def landmarks_of_all(self, keyframes: Sequence[KeyframeId]) -> I32:
        """Slots of the landmarks that any of some keyframes observes, in order of id."""
        slots = np.concatenate([self.slots_of(keyframe) for keyframe in keyframes])
        return self.sorted_by_id(self.keypoints.root[slots[self._is_valid(slots)]])

    def sorted_by_id(self, landmarks: I32) -> I32:
        """Unique landmarks in order of id, which does not depend on the order of arrival."""
        ids = self.landmark_ids(landmarks)
        order = np.argsort(ids, kind="stable")
        ids = ids[order]
        first = np.ones(len(ids), np.bool_)
        np.not_equal(ids[1:], ids[:-1], out=first[1:])
        return np.asarray(landmarks[order[first]])

    def live_landmarks(self) -> I32:
        """Slots of all root landmarks that are not culled, in order of id."""
        here = np.arange(self.slots, dtype=np.int32)
        return self.sorted_by_id(here[self.is_live(here)])

    def is_live(self, slots: I32) -> Bool:
        """Whether slots (n,) are root landmarks that are not culled."""
        table = self.keypoints
        is_root = (table.kind[slots] == LANDMARK) & (table.root[slots] == slots)
        return np.asarray(is_root & (table.flags[slots] & CULLED == 0))

    def is_live_landmark(self, slot: int) -> bool:
        """The same of one slot, in a twentieth of the time."""
        table = self.keypoints
        return bool(table.kind[slot] == LANDMARK and table.root[slot] == slot and not table.flags[slot] & CULLED)

    def live_in(self, row: int) -> int:
        """Number of root landmarks of a keyframe that are not culled."""
        start = int(self.keyframes.start[row])
        slots = np.arange(start, start + int(self.keyframes.count[row]), dtype=np.int32)
        return int(np.count_nonzero(self.is_live(slots)))

    def count_live(self) -> int:
        """Number of root landmarks that are not culled."""
        return int(self.keyframes.live[: self.height].sum())

    def live_by_submap(self) -> dict[SubmapId, int]:
        """Number of root landmarks that are not culled, by submap."""
        return {submap: int(self.keyframes.live[self.rows_of(submap)].sum()) for submap in self.submaps}

    def observations(self, landmarks: I32) -> tuple[I32, I32]:
        """Valid observations of landmarks (n,), in order of keyframe id, one per keyframe.

        Returns starts (n + 1,) and slots: those of landmark i are slots[starts[i]:starts[i + 1]].
        """
        table = self.keypoints
        starts = np.empty(len(landmarks) + 1, np.int32)
        slots = np.empty(kernels.count(landmarks, table.first, table.next), np.int32)
        n = kernels.gather(
            landmarks, table.first, table.next, table.row, table.usable, self.keyframes.id, starts, slots
        )  # fmt: skip
        return starts, slots[:n]

    def covisibility(self, landmarks: I32) -> I32:
        """Number of the landmarks (n,) that each keyframe observes, by row."""
        shared = np.zeros(self.height, np.int32)
        table = self.keypoints
        kernels.covisibility(landmarks, table.first, table.next, table.row, table.usable, shared)
        return shared

    def covisible_keyframes(self, keyframe: KeyframeId, min_shared: int) -> list[KeyframeId]:
        """Keyframes of the same map that share at least min_shared landmarks, most first, newer first among equals."""
        shared = self.covisibility(self.landmarks_of(keyframe))
        rows = np.flatnonzero(shared >= max(min_shared, 1))
        ids = self.keyframes.id[rows]
        order = np.lexsort((-ids, -shared[rows]))
        return [k for k in map(KeyframeId, ids[order].tolist()) if k != keyframe]

    def covisible_pairs(self, rows: I32, min_shared: int) -> I64:
        """Pairs (p,2) of keyframes that share min_shared landmarks or more: numbers in rows (n,), the lower first."""
        keyframes, table, n = self.keyframes, self.keypoints, self.slots
        number, seen = np.full(self.height, -1, np.int32), np.full(n, -1, np.int32)
        number[rows] = np.arange(len(rows), dtype=np.int32)
        is_live = ((table.kind[:n] == LANDMARK) & (table.flags[:n] & CULLED == 0)).astype(np.uint8)
        shared, touched = np.zeros(self.height, np.int32), np.empty(self.height, np.int32)
        room = 16 * len(rows)
        while True:
            pairs = np.empty((2, room), np.int64)
            found = kernels.strong_pairs(
                rows, keyframes.start, keyframes.count, table.usable, table.root, is_live, table.first, table.next,
                table.row, number, max(min_shared, 1), shared, touched, seen, pairs[0], pairs[1],
            )  # fmt: skip
            if found <= room:
                return np.ascontiguousarray(pairs[:, :found].T)
            room = found
            seen.fill(-1)

    def observed_together(self, a: int, b: int) -> bool:
        """True if a keyframe observes both landmarks, so that they cannot be the same."""
        table = self.keypoints
        return bool(kernels.share_keyframe(a, b, table.first, table.next, table.row, table.usable))

    def inverse_depths(self, landmarks: I32) -> F64:
        """Inverse depths (n,) of landmarks in their keyframes, refined or as measured; 0 unknown.

        In 1/m, or in the unit of a monocular submap.
        """
        table = self.keypoints
        refined = table.flags[landmarks] & REFINED != 0
        return np.where(refined, table.refined[landmarks], table.inv_depth[landmarks]).astype(np.float64)

    def positions(self, landmarks: I32) -> tuple[F64, Bool]:
        """Positions (n,3) of landmarks in w, m, and whether each is known."""
        table, keyframes = self.keypoints, self.keyframes
        landmarks = np.asarray(landmarks, np.int32)
        rows = table.row[landmarks]
        inv = self.inverse_depths(landmarks)
        known = (inv > 0) & (keyframes.pose_source[rows] != NO_POSE) & (table.kind[landmarks] == LANDMARK)
        known &= keyframes.camera[rows, 0] > 0
        out = np.empty((len(landmarks), 3))
        kernels.positions(
            landmarks, np.where(known, inv, 1.0), table.row, table.uv, table.offset, keyframes.scale, keyframes.camera,
            keyframes.T_w_k, out,
        )  # fmt: skip
        return out, known

    def has_position(self, landmark: int) -> bool:
        """Whether `positions` has a position of a landmark."""
        table, row = self.keypoints, self.keypoints.row[landmark]
        inverse = (table.refined if table.flags[landmark] & REFINED else table.inv_depth)[landmark]
        known = inverse > 0 and self.keyframes.pose_source[row] != NO_POSE and table.kind[landmark] == LANDMARK
        return bool(known and self.keyframes.camera[row, 0] > 0)

    def project_into_anchor(self, landmarks: I32, positions: F64) -> tuple[F32, F32, Bool]:
        """The inverse of `positions`: inverse depths (n,), offsets (n,2) px, whether in front of the keyframe (n,)."""
        rows = self.keypoints.row[landmarks]
        pose = self.keyframes.T_w_k[rows]
        local = np.einsum("nji,nj->ni", pose[:, :3, :3], positions - pose[:, :3, 3])
        ahead = local[:, 2] > 1e-3
        inv = 1.0 / np.where(ahead, local[:, 2], 1.0)
        fx, fy, cx, cy = self.keyframes.camera[rows, :4].T
        u, v = fx * local[:, 0] * inv + cx, fy * local[:, 1] * inv + cy
        offset = np.stack([u, v], 1) - self.keypoints.uv[landmarks]
        return (inv * self.keyframes.scale[rows]).astype(np.float32), offset.astype(np.float32), ahead

    def pose(self, keyframe: KeyframeId) -> F64 | None:
        """T_m_k (4,4) of a keyframe; None if it is unknown or a parent is missing."""
        row = self.rows.get(keyframe)
        if row is None or self.keyframes.pose_source[row] == NO_POSE:
            return None
        return np.asarray(self.keyframes.T_m_k[row]).copy()

    def world_pose(self, keyframe: KeyframeId) -> F64 | None:
        """T_w_k (4,4) of a keyframe; None as for `pose`."""
        row = self.rows.get(keyframe)
        if row is None or self.keyframes.pose_source[row] == NO_POSE:
            return None
        return np.asarray(self.keyframes.T_w_k[row]).copy()

    def first_pose(self, submap: SubmapId) -> F64:
        """T_m_k (4,4) of the first keyframe of a submap; the identity if it has no pose."""
        begin = self.pose(self.submaps[submap][0]) if submap in self.submaps else None
        return np.eye(4) if begin is None else begin

    def submap_pose(self, submap: SubmapId) -> F64:
        """S_w_m (4,4) of a submap: rigid, or a similarity if its unit of length differs from that of w."""
        held = self.submap_poses.get(submap)
        return np.eye(4) if held is None else held.copy()

    def scale(self, submap: SubmapId) -> float:
        """Length in w of one unit of a submap."""
        return self._scales.get(submap, 1.0)

    def is_up_to_scale(self, submap: SubmapId) -> bool:
        """True for a monocular submap of unknown metric scale."""
        return not (self.is_ranged(submap) or submap in self.metric_submaps)

    def is_ranged(self, submap: SubmapId) -> bool:
        """True if images of a submap measure distances, or may."""
        return self.measures_distances(agent_of_submap(submap))

    def measures_distances(self, agent: AgentId) -> bool:
        """True if the images of an agent do, or may: no frame of a single camera has told otherwise."""
        camera = self.cameras.get(agent)
        return camera is None or camera.stereo or agent in self.measures_depth

    def has_metric_scale_by_imu(self, submap: SubmapId) -> bool:
        """True for a monocular submap in metres: its scale is as good as the agent's IMU knew it."""
        return submap in self.metric_submaps and not self.is_ranged(submap)

    def is_onboard_offset(self, agent: AgentId) -> bool:
        """True if the disparity offset of an agent is the one that it found on board, unchanged."""
        offset = self.disparity_offset_px[agent]
        if agent in self.onboard_sigma_px:
            return offset is self.known_offset_px[agent]
        return self.is_good_offset(agent)

    def is_good_offset(self, agent: AgentId) -> bool:
        """True if the disparity offset of an agent is a good calibration's that it found on board, unchanged."""
        return self.disparity_offset_px[agent] is self.good_offset_px.get(agent)

    def offset_measured_with(self, keyframe: KeyframeId) -> F64:
        """Disparity offset (5,) px that an agent corrected for when it measured the motion to a keyframe.

        That of the newest note up to it in its submap: ids of a later start may be smaller than of an earlier one.
        """
        noted = sorted(self.measured_with_px)
        before = bisect_right(noted, keyframe)
        if not before or submap_of_keyframe(noted[before - 1]) != submap_of_keyframe(keyframe):
            return disparity_offset.none()
        return self.measured_with_px[noted[before - 1]]

    def map_id(self, submap: SubmapId) -> SubmapId:
        """The root submap of the map that a submap belongs to."""
        return self.root_submaps.get(submap, submap)

    def map_of(self, slot: int) -> SubmapId:
        """The map that the keyframe of a keypoint belongs to."""
        return self.map_id(submap_of_keyframe(KeyframeId(int(self.keyframes.id[self.keypoints.row[slot]]))))

    def submaps_of_map(self, submap: SubmapId) -> list[SubmapId]:
        """All submaps of the map that a submap belongs to, in order of id."""
        map_id = self.map_id(submap)
        return sorted({map_id} | {s for s, root in self.root_submaps.items() if root == map_id})

    def is_complete(self, keyframe: KeyframeId) -> bool:
        """True if all keypoints that the header announced have arrived."""
        row = self.rows[keyframe]
        return bool(self.keyframes.filled[row] >= self.keyframes.count[row])

    def nbytes(self) -> int:
        """Bytes of all arrays, spare capacity included."""
        tables: tuple[KeyframeTable | KeypointTable, ...] = (self.keyframes, self.keypoints)
        return sum(getattr(t, f.name).nbytes for t in tables for f in fields(t))

    def _is_valid(self, slots: I32) -> Bool:
        table = self.keypoints
        root = table.root[slots]
        alive = (table.usable[slots] != 0) & (root >= 0)
        alive[alive] = (table.flags[root[alive]] & CULLED == 0) & (table.kind[root[alive]] == LANDMARK)
        return np.asarray(alive)

"""The sparse map: keyframes, their keypoints and the points that hang on them, as structures of arrays keyed by id.

Points hang on keyframes: a point is a pixel of the keyframe of its birth (its *anchor*) and an inverse depth, so that
it moves with its keyframe. Each keypoint owns one *slot* (its row in `keypoints`); a point is named inside the map by
the slot of its birth. `root` maps every slot to the point it observes, fused points to the one they were fused into.
Sections may come in any order and any number of times; what a section does not know yet is linked when it comes.
"""

from __future__ import annotations

from bisect import insort

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.map import sparse_map_kernels as kernels
from kiteline_basestation.map.map_tables import (
    COMPOSED,
    EMPTY,
    LANDMARK,
    NO_POSE,
    OBSERVATION,
    REFINED,
    REFINED_POSE,
    REMOVED,
    grow,
)
from kiteline_basestation.map.map_view import MapView
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import (
    KEYPOINT_BITS,
    MAX_KEYPOINTS,
    NO_KEYFRAME,
    NO_LANDMARK,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    submap_of_keyframe,
)

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]


class SparseMap(MapView):
    """Keyframes, keypoints and points of any number of agents and submaps. Row and slot numbers never change."""

    # -- what the agents wrote ---------------------------------------------------------------------------------------

    def set_camera(self, agent: AgentId, camera: RectifiedCamera) -> None:
        """The ideal camera of an agent; keyframes that are already here take it on."""
        self.cameras[agent] = camera
        for keyframe, row in self.rows.items():
            if agent_of_keyframe(keyframe) == agent:
                self.keyframes.camera[row] = _parameters(camera)

    def add_keyframe(self, keyframe: KeyframeId, t_ns: int, parent: KeyframeId, T_p_k: F64, keypoints: int) -> int:
        """Add a keyframe, or renew its header. T_p_k: (4,4). Returns its row.

        Raises ValueError on too many keypoints, or a parent that is not an older keyframe of the same submap.
        """
        if not 0 <= keypoints <= MAX_KEYPOINTS:
            raise ValueError(f"keyframe {keyframe} claims {keypoints} keypoints: expected at most {MAX_KEYPOINTS}")
        if parent != NO_KEYFRAME and not (
            parent < keyframe and submap_of_keyframe(parent) == submap_of_keyframe(keyframe)
        ):
            raise ValueError(f"keyframe {keyframe} names parent {parent}: expected an older one of its submap")
        table = self.keyframes
        row = self.rows.get(keyframe)
        if row is None:
            row = len(self.rows)
            if row == len(table.id):
                grow(table, row + max(32, row // 4))
            self.rows[keyframe] = row
            insort(self.submaps.setdefault(submap_of_keyframe(keyframe), []), keyframe)
            table.id[row] = keyframe
            table.start[row] = self._allocate(row, keypoints)
            table.count[row] = keypoints
            table.unit[row] = 1.0
            camera = self.cameras.get(agent_of_keyframe(keyframe))
            if camera is not None:
                table.camera[row] = _parameters(camera)
            self._children.setdefault(parent, []).append(row)
        elif table.parent[row] != parent:
            self._children[KeyframeId(int(table.parent[row]))].remove(row)
            self._children.setdefault(parent, []).append(row)
        table.t_ns[row] = t_ns
        table.parent[row] = parent
        table.T_p_k[row] = T_p_k
        if table.pose_source[row] != REFINED_POSE:
            self._compose(row)
        waiting = self._waiting.pop(keyframe, None)
        if waiting is not None:
            self._link_observations(np.array(waiting, np.int32))
        return row

    def put_new_landmarks(
        self, keyframe: KeyframeId, part: int, index: NDArray[np.uint16], uv: F32, inv_depth: F32, octave: U8,
        angle: U8, descriptor: U8,
    ) -> None:  # fmt: skip
        """Births of a keyframe whose header is here (see codec schema Births); a newer part replaces an older one."""
        slots, keep = self._section(keyframe, part, index, LANDMARK)
        table = self.keypoints
        table.uv[slots] = uv[keep]
        table.inv_depth[slots] = inv_depth[keep]
        table.octave[slots] = octave[keep]
        table.angle[slots] = angle[keep]
        table.descriptor[slots] = descriptor[keep]
        fresh = slots[table.kind[slots] != LANDMARK]
        table.kind[slots] = LANDMARK
        table.part[slots] = part
        table.point[slots] = NO_LANDMARK
        kernels.link(fresh, fresh, table.root, table.first, table.next)
        self._refresh_usable(self.rows[keyframe])

    def put_observations(
        self,
        keyframe: KeyframeId,
        part: int,
        index: NDArray[np.uint16],
        uv: F32,
        inv_depth: F32,
        octave: U8,
        point: I64,
    ) -> None:
        """Sightings of a keyframe whose header is here (see codec schema Sightings); a newer part replaces an older."""
        slots, keep = self._section(keyframe, part, index, OBSERVATION)
        table = self.keypoints
        table.uv[slots] = uv[keep]
        table.inv_depth[slots] = inv_depth[keep]
        table.octave[slots] = octave[keep]
        table.kind[slots] = OBSERVATION
        table.part[slots] = part
        table.point[slots] = point[keep]
        if bool(np.any(inv_depth > 0)):
            self.measures_depth.add(agent_of_keyframe(keyframe))
        self._link_observations(slots)
        self._refresh_usable(self.rows[keyframe])

    # -- what the base wrote -----------------------------------------------------------------------------------------

    def set_pose(self, keyframe: KeyframeId, T_m_k: F64) -> None:
        """The base's pose (4,4) of a keyframe; descendants without a base value move along."""
        row = self.rows[keyframe]
        had = self.keyframes.pose_source[row]
        self.keyframes.T_m_k[row] = T_m_k
        self._follow(row)
        self.keyframes.pose_source[row] = REFINED_POSE
        if had == NO_POSE:
            self._refresh_usable(row)
        self._compose_children(keyframe)

    def set_world_pose(self, keyframe: KeyframeId, T_w_k: F64) -> None:
        """The base's pose of a keyframe, said in w; its submap stays where it is."""
        frame = self.submap_poses.get(submap_of_keyframe(keyframe))
        self.set_pose(keyframe, T_w_k if frame is None else se3.orthonormalise(sim3.place(sim3.inverse(frame), T_w_k)))

    def move_submap(self, submap: SubmapId, S_w_m: F64) -> None:
        """Lay a submap, with all that hangs on it, at S_w_m (4,4): a rigid motion, or with another unit of length."""
        if submap in self.submap_poses or not np.array_equal(S_w_m, np.eye(4)):
            self.submap_poses[submap] = np.array(S_w_m)
            self._scales[submap] = sim3.scale_of(S_w_m)
        for keyframe in self.submaps.get(submap, []):
            self._follow(self.rows[keyframe])

    def scale_submap(self, submap: SubmapId, factor: float) -> None:
        """Let lengths of a submap be so many times as long in w; its beginning stays where it is."""
        self.move_submap(submap, sim3.grown(self.submap_pose(submap), factor, self.first_pose(submap)))

    def first_pose(self, submap: SubmapId) -> F64:
        """T_m_k (4,4) of the first keyframe of a submap; the identity while that has no pose."""
        begin = self.pose(self.submaps[submap][0]) if submap in self.submaps else None
        return np.eye(4) if begin is None else begin

    def set_depths(self, slots: I32, inv_depth: F32, offset: F32) -> None:
        """The base's positions of the points born at `slots` (n,): inv_depth (n,) 1/m, offset (n,2) px."""
        self.keypoints.refined[slots] = inv_depth
        self.keypoints.offset[slots] = offset
        self.keypoints.flags[slots] |= REFINED

    def set_flags(self, slots: I32, bit: int) -> None:
        """Set REMOVED (observations) or CULLED (points) at `slots` (n,)."""
        self.keypoints.flags[slots] |= bit
        for row in np.unique(self.keypoints.row[slots]).tolist():
            self._refresh_usable(row)

    def cull_keyframe(self, keyframe: KeyframeId) -> None:
        """Drop a keyframe's observations; its pose stays while points hang on it."""
        row = self.rows[keyframe]
        self.keyframes.culled[row] = 1
        self._refresh_usable(row)

    def fuse(self, child: int, parent: int) -> list[KeyframeId]:
        """Make the point born at slot `child` an alias of the point born at slot `parent` (both roots).

        Returns the keyframes, sorted, that have births which now show another root than before.
        """
        table = self.keypoints
        one = np.array([child], np.int32)
        moved = np.empty(kernels.count(one, table.first, table.next), np.int32)
        kernels.fuse(child, parent, table.root, table.first, table.next, moved)
        births = moved[table.kind[moved] == LANDMARK]
        rows = np.union1d(table.row[births], table.row[one])
        return [KeyframeId(k) for k in np.sort(self.keyframes.id[rows]).tolist()]

    def unfuse(self, births: I32) -> None:
        """The opposite of `fuse` for births at slots (n,): each is a point of its own again, seen where it is named."""
        table = self.keypoints
        kernels.link(births, births, table.root, table.first, table.next)
        hangs = (table.kind[: self.slots] == OBSERVATION) & (table.root[: self.slots] >= 0)
        slots = np.flatnonzero(hangs).astype(np.int32)
        self._link_observations(slots[np.isin(self.find_landmarks(table.point[slots]), births)])

    # -- inside ------------------------------------------------------------------------------------------------------

    def _allocate(self, row: int, keypoints: int) -> int:
        start, table = self.slots, self.keypoints
        self.slots += keypoints
        if self.slots > len(table.row):
            grow(table, self.slots + max(8192, self.slots // 4))
        new = slice(start, self.slots)
        table.row[new] = row
        table.root[new] = -1
        table.first[new] = -1
        table.next[new] = -1
        table.point[new] = NO_LANDMARK
        return start

    def _section(self, keyframe: KeyframeId, part: int, index: NDArray[np.uint16], kind: int) -> tuple[I32, Bool]:
        """Slots of a section's rows, and which rows fit the header; what an older version of it had is withdrawn."""
        row = self.rows[keyframe]
        keep = index < self.keyframes.count[row]
        slots = (int(self.keyframes.start[row]) + index[keep].astype(np.int32)).astype(np.int32)
        table = self.keypoints
        mine = self.slots_of(keyframe)
        old = mine[(table.kind[mine] == kind) & (table.part[mine] == part)]
        gone = np.setdiff1d(old, slots).astype(np.int32)
        turned = slots[(table.kind[slots] != EMPTY) & (table.kind[slots] != kind)]
        gone = np.union1d(gone, turned).astype(np.int32)
        kernels.link(gone, np.full(len(gone), -1, np.int32), table.root, table.first, table.next)
        table.kind[gone] = EMPTY
        return slots, keep

    def _link_observations(self, slots: I32) -> None:
        """Hang sightings on the points they name; those whose keyframe is not here wait for it."""
        table = self.keypoints
        slots = slots[table.kind[slots] == OBSERVATION]
        named = self.find_landmarks(table.point[slots])
        roots = np.full(len(slots), -1, np.int32)
        known = named >= 0
        target = named[known]
        # A point that was fused is followed to its root; one whose own section is still to come is its own root.
        fused = (table.kind[target] == LANDMARK) & (table.root[target] >= 0)
        roots[known] = np.where(fused, table.root[target], target)
        kernels.link(slots, roots, table.root, table.first, table.next)
        for slot in slots[~known].tolist():
            anchor = KeyframeId(int(table.point[slot]) >> KEYPOINT_BITS)
            if anchor not in self.rows:
                self._waiting.setdefault(anchor, []).append(slot)

    def _refresh_usable(self, row: int) -> None:
        table = self.keypoints
        start = int(self.keyframes.start[row])
        mine = slice(start, start + int(self.keyframes.count[row]))
        open_ = self.keyframes.culled[row] == 0 and self.keyframes.pose_source[row] != NO_POSE
        here = table.kind[mine] != EMPTY
        table.usable[mine] = here & (table.flags[mine] & REMOVED == 0) & open_
        self.keyframes.filled[row] = np.count_nonzero(here)

    def _compose(self, row: int) -> None:
        """Set a pose from the parent's (or from the submap frame), and those of the descendants that hang on it."""
        table = self.keyframes
        parent = KeyframeId(int(table.parent[row]))
        if parent == NO_KEYFRAME:
            table.T_m_k[row] = table.T_p_k[row]
        else:
            above = self.rows.get(parent)
            if above is None or table.pose_source[above] == NO_POSE:
                return
            table.T_m_k[row] = table.T_m_k[above] @ table.T_p_k[row]
        self._follow(row)
        table.pose_source[row] = COMPOSED
        self._refresh_usable(row)
        self._compose_children(KeyframeId(int(table.id[row])))

    def _follow(self, row: int) -> None:
        """Where a keyframe lies in w, from its place in m."""
        table = self.keyframes
        submap = submap_of_keyframe(KeyframeId(int(table.id[row])))
        frame, unit = self.submap_poses.get(submap), self._scales.get(submap, 1.0)
        table.unit[row] = unit
        table.T_w_k[row] = table.T_m_k[row] if frame is None else frame @ table.T_m_k[row]
        if unit != 1.0:
            table.T_w_k[row, :3, :3] /= unit

    def _compose_children(self, keyframe: KeyframeId) -> None:
        table = self.keyframes
        open_ = [keyframe]
        while open_:
            above = open_.pop()
            for row in self._children.get(above, []):
                if table.pose_source[row] == REFINED_POSE:
                    continue
                table.T_m_k[row] = table.T_m_k[self.rows[above]] @ table.T_p_k[row]
                self._follow(row)
                if table.pose_source[row] == NO_POSE:
                    table.pose_source[row] = COMPOSED
                    self._refresh_usable(row)
                open_.append(KeyframeId(int(table.id[row])))


def _parameters(camera: RectifiedCamera) -> tuple[float, float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy, camera.bf

"""The sparse map: keyframes, keypoints and landmarks as structures of arrays.

A landmark is a keypoint of the keyframe that observed it first (its anchor) with an inverse depth, so that it moves
with that keyframe. Each keypoint has one slot (row of `keypoints`), and a landmark is named by its slot. `root` is the
landmark that a keypoint observes; for a fused landmark, the root landmark. Records may come in any order, repeatedly.
"""

from bisect import bisect_right
from collections.abc import Collection, Sequence

import numpy as np

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
    clear,
    grow,
)
from kiteline_basestation.map.map_view import Rows
from kiteline_basestation.map.rig_values import RigValues, parameters
from kiteline_basestation.map.world_poses import in_submap, is_near, place_in_world
from kiteline_core.arrays import F32, F64, I32, I64, U8, U16, Bool
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import (
    KEYPOINT_BITS,
    MAX_KEYPOINTS,
    NO_KEYFRAME,
    NO_LANDMARK,
    SEQUENCE_BITS,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    submap_of_keyframe,
)

_MOST_WAITED_FOR = 100_000  # keyframes that observations name and that were not received: only a faulty agent has more


class SparseMap(RigValues):
    """Keyframes, keypoints and landmarks of all agents. Row and slot numbers change only by being forgotten."""

    # -- values of the agents ------------------------------------------------------------------------------------------

    def add_keyframe(self, keyframe: KeyframeId, t_ns: int, parent: KeyframeId, T_p_k: F64, keypoints: int) -> int:
        """Add a keyframe, or update its header. T_p_k: (4,4). Returns its row.

        Raises ValueError for too many keypoints, or a parent that is not an older keyframe of the same submap.
        """
        if not 0 <= keypoints <= MAX_KEYPOINTS:
            raise ValueError(f"keyframe {keyframe} claims {keypoints} keypoints: expected at most {MAX_KEYPOINTS}")
        is_older = parent < keyframe and submap_of_keyframe(parent) == submap_of_keyframe(keyframe)
        if not (parent == NO_KEYFRAME or is_older):
            raise ValueError(f"keyframe {keyframe} names parent {parent}: expected an older one of its submap")
        table = self.keyframes
        row = self.rows.get(keyframe)
        if row is None:
            free = self._free_rows.take()
            self.height = max(self.height, (row := self.height if free is None else free) + 1)
            if row == len(table.id):
                grow(table, row + max(32, row // 4))
            self.rows[keyframe] = row
            self._enter(keyframe, row)
            self.note_offset(keyframe)
            table.id[row] = keyframe
            table.start[row] = self._allocate(row, keypoints)
            table.count[row] = keypoints
            table.scale[row] = 1.0
            camera = self.cameras.get(agent_of_keyframe(keyframe))
            if camera is not None:
                table.camera[row] = parameters(camera)
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
            self._link_observations(np.array(list(waiting), np.int32))
        return row

    def _enter(self, keyframe: KeyframeId, row: int) -> None:
        """Add a keyframe to its submap."""
        submap = submap_of_keyframe(keyframe)
        keyframes = self.submaps.setdefault(submap, [])
        at = bisect_right(keyframes, keyframe)
        keyframes.insert(at, keyframe)
        self._rows_of.setdefault(submap, Rows()).insert(at, row)

    def put_new_landmarks(
        self, keyframe: KeyframeId, part: int, index: U16, uv: F32, inv_depth: F32, octave: U8,
        angle: U8, descriptor: U8,
    ) -> None:  # fmt: skip
        """Set the new landmarks of a known keyframe (see codec NewLandmarks); a part replaces its older version."""
        slots, keep = self._slots_of_record(keyframe, part, index, LANDMARK)
        table = self.keypoints
        table.uv[slots] = uv[keep]
        table.inv_depth[slots] = inv_depth[keep]
        table.octave[slots] = octave[keep]
        table.angle[slots] = angle[keep]
        table.descriptor.put(slots, descriptor[keep])
        fresh = slots[table.kind[slots] != LANDMARK]
        table.kind[slots] = LANDMARK
        table.part[slots] = part
        table.landmark[slots] = NO_LANDMARK
        kernels.link(fresh, fresh, table.root, table.first, table.next)
        self._refresh_usable(self.rows[keyframe])

    def put_observations(
        self, keyframe: KeyframeId, part: int, index: U16, uv: F32, inv_depth: F32, octave: U8,
        landmark: I64,
    ) -> None:  # fmt: skip
        """Set the observations of a known keyframe (see codec Observations); a part replaces its older version."""
        slots, keep = self._slots_of_record(keyframe, part, index, OBSERVATION)
        table = self.keypoints
        table.uv[slots] = uv[keep]
        table.inv_depth[slots] = inv_depth[keep]
        table.octave[slots] = octave[keep]
        table.kind[slots] = OBSERVATION
        table.part[slots] = part
        table.landmark[slots] = landmark[keep]
        if bool(np.any(inv_depth > 0)):
            self.measures_depth.add(agent_of_keyframe(keyframe))
        self._link_observations(slots)
        self._refresh_usable(self.rows[keyframe])

    def set_camera(self, agent: AgentId, camera: RectifiedCamera) -> None:
        """Set the rectified camera of an agent; see `RigValues`. Observations are usable from the first one on."""
        is_first = agent not in self.cameras
        super().set_camera(agent, camera)
        if is_first:
            for row in [row for keyframe, row in self.rows.items() if agent_of_keyframe(keyframe) == agent]:
                self._refresh_usable(row)

    # -- values of the base ------------------------------------------------------------------------------------------

    def set_pose(self, keyframe: KeyframeId, T_m_k: F64, *, carry: bool = True) -> None:
        """Set the refined pose (4,4) of a keyframe, unless it is too far off. carry: descendants without a refined pose
        move along.
        """
        row = self.rows[keyframe]
        had = self.keyframes.pose_source[row]
        if not self._put_pose(row, T_m_k):
            return
        self.keyframes.pose_source[row] = REFINED_POSE
        if had == NO_POSE:
            self._refresh_usable(row)
        if carry:
            self._compose_children(keyframe)

    def set_world_pose(self, keyframe: KeyframeId, T_w_k: F64, *, carry: bool = True) -> None:
        """Set the refined pose (4,4) of a keyframe, given in w; its submap does not move. carry: as for `set_pose`."""
        if (S_w_m := self.submap_poses.get(submap_of_keyframe(keyframe))) is not None:
            T_w_k = se3.orthonormalise(sim3.place(sim3.inverse(S_w_m), T_w_k))
        self.set_pose(keyframe, T_w_k, carry=carry)

    def set_world_poses(self, keyframes: Sequence[KeyframeId], T_w_k: F64) -> None:
        """Set (n,4,4) in w, but far ones, of keyframes with refined poses; submaps and descendants do not move."""
        rows = np.array([self.rows[k] for k in keyframes], np.int32)
        submaps = self.keyframes.id[rows] >> SEQUENCE_BITS
        for submap in map(SubmapId, np.unique(submaps).tolist()):
            inside = submaps == submap
            T_m_k = in_submap(T_w_k[inside], self.submap_poses.get(submap))
            near = np.array([is_near(T) for T in T_m_k], np.bool_)
            self.far_poses += int(np.count_nonzero(~near))
            self.keyframes.T_m_k[rows[inside][near]] = T_m_k[near]
            self._update_world_poses(submap, rows[inside])

    def compose(self, keyframe: KeyframeId) -> None:
        """Compose the pose of a keyframe without a refined one from its parent's pose; its children stay."""
        table, row = self.keyframes, self.rows[keyframe]
        self._put_pose(row, table.T_m_k[self.rows[KeyframeId(int(table.parent[row]))]] @ table.T_p_k[row])

    def move_submap(self, submap: SubmapId, S_w_m: F64) -> None:
        """Set S_w_m (4,4) of a submap; its keyframes and landmarks move along."""
        if submap in self.submap_poses or not np.array_equal(S_w_m, np.eye(4)):
            self.submap_poses[submap] = np.array(S_w_m)
            self._scales[submap] = sim3.scale_of(S_w_m)
        self._update_world_poses(submap, self.rows_of(submap))

    def scale_submap(self, submap: SubmapId, factor: float) -> None:
        """Multiply the scale of a submap in w; its first keyframe does not move."""
        self.move_submap(submap, sim3.scaled_about(self.submap_pose(submap), factor, self.first_pose(submap)))

    def set_depths(self, slots: I32, inv_depth: F32, offset: F32) -> None:
        """Set refined positions of landmarks (n,): inv_depth (n,) 1/m, offset (n,2) px."""
        self.keypoints.refined[slots] = inv_depth
        self.keypoints.offset[slots] = offset
        self.keypoints.flags[slots] |= REFINED

    def set_flags(self, slots: I32, bit: int) -> None:
        """Set flag REMOVED (of observations) or CULLED (of landmarks) at `slots` (n,)."""
        self.keypoints.flags[slots] |= bit
        for row in np.unique(self.keypoints.row[slots]).tolist():
            self._refresh_usable(row)

    def cull_keyframe(self, keyframe: KeyframeId) -> None:
        """Drop the observations of a keyframe; its pose stays as the anchor of its landmarks."""
        row = self.rows[keyframe]
        self.keyframes.culled[row] = 1
        self._refresh_usable(row)

    def fuse(self, child: int, parent: int) -> list[KeyframeId]:
        """Fuse root landmark `child` into `parent`; the keyframes, sorted, of landmarks that have another root now."""
        table = self.keypoints
        self.keyframes.live[table.row[child]] -= self.is_live_landmark(child)
        moved = np.empty(kernels.count(np.array([child], np.int32), table.first, table.next), np.int32)
        kernels.fuse(child, parent, table.root, table.first, table.next, moved)
        rows = {int(table.row[child]), *table.row[moved[table.kind[moved] == LANDMARK]].tolist()}
        return sorted(KeyframeId(k) for k in self.keyframes.id[list(rows)].tolist())

    def unfuse(self, landmarks: I32) -> None:
        """Undo `fuse`: each landmark (n,) is a root again, with the observations that name it."""
        table = self.keypoints
        kernels.link(landmarks, landmarks, table.root, table.first, table.next)
        for row in np.unique(table.row[landmarks]).tolist():
            self.keyframes.live[row] = self.live_in(row)
        linked = (table.kind[: self.slots] == OBSERVATION) & (table.root[: self.slots] >= 0)
        slots = np.flatnonzero(linked).astype(np.int32)
        self._link_observations(slots[np.isin(self.find_landmarks(table.landmark[slots]), landmarks)])

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Forget submaps. Their rows and slots, which nothing may name any more, are free for the next keyframes."""
        table, keyframes = self.keypoints, [k for s in submaps for k in self.submaps.get(s, [])]
        if keyframes:
            here = np.concatenate([self.slots_of(k) for k in keyframes])
            inside = np.zeros(self.slots + 1, np.bool_)  # the last one: of no landmark
            inside[here] = True
            roots = table.root[: self.slots]
            outside = np.flatnonzero(inside[roots] & ~inside[:-1]).astype(np.int32)
            kernels.link(here, np.full(len(here), -1, np.int32), table.root, table.first, table.next)
            is_landmark = table.kind[outside] == LANDMARK
            fused, left = outside[is_landmark], outside[~is_landmark]
            kernels.link(left, np.full(len(left), -1, np.int32), table.root, table.first, table.next)
            kernels.link(fused, fused, table.root, table.first, table.next)  # they are roots again
            for row in np.unique(table.row[fused]).tolist():
                self.keyframes.live[row] = self.live_in(row)
            clear(table, here)
            for links in (table.root, table.first, table.next, table.landmark):
                links[here] = -1
            rows = np.array([self.rows.pop(k) for k in keyframes], np.int32)
            runs = np.column_stack([self.keyframes.count[rows], self.keyframes.start[rows]])
            self._free_slots.free((length, begin) for length, begin in runs.tolist())
            clear(self.keyframes, rows)
            self._free_rows.free((1, row) for row in rows.tolist())
            self.moved_rows.difference_update(rows.tolist())
            self._children[NO_KEYFRAME] = sorted({*self._children.get(NO_KEYFRAME, [])} - {*rows.tolist()})
            self._link_observations(left[self.find_landmarks(table.landmark[left]) >= 0])
            for anchor, slots in list(self._waiting.items()):
                self._waiting[anchor] = {slot: None for slot in slots if not inside[slot]}
                if not self._waiting[anchor]:
                    del self._waiting[anchor]
        gone = set(submaps)
        for of_keyframe in (self._children, self._waiting, self.inertial_steps, self.up, self.measured_with_px):
            for keyframe in [k for k in of_keyframe if submap_of_keyframe(k) in gone]:  # also of those that never came
                del of_keyframe[keyframe]
        for submap in submaps:
            for of_submap in (self.submaps, self._rows_of, self.keypoints_of, self.submap_poses, self._scales,
                              self.root_submaps, self.metres_per_unit):  # fmt: skip
                of_submap.pop(submap, None)
            self.metric_submaps.discard(submap)
            self.scaled_submaps.discard(submap)

    # -- inside ------------------------------------------------------------------------------------------------------

    def _allocate(self, row: int, keypoints: int) -> int:
        table, free = self.keypoints, self._free_slots.take(keypoints) if keypoints else None
        start = self.slots if free is None else free
        self.slots = max(self.slots, start + keypoints)
        if self.slots > len(table.row):
            grow(table, self.slots + max(8192, self.slots // 4))
        new = slice(start, start + keypoints)
        table.row[new] = row
        table.root[new] = -1
        table.first[new] = -1
        table.next[new] = -1
        table.landmark[new] = NO_LANDMARK
        return start

    def _slots_of_record(self, keyframe: KeyframeId, part: int, index: U16, kind: int) -> tuple[I32, Bool]:
        """Slots for the rows of a record, and which rows fit the header. Clears rows of the record's older version."""
        row = self.rows[keyframe]
        keep = index < self.keyframes.count[row]
        slots = (int(self.keyframes.start[row]) + index[keep].astype(np.int32)).astype(np.int32)
        table = self.keypoints
        mine = self.slots_of(keyframe)
        old = mine[(table.kind[mine] == kind) & (table.part[mine] == part)]
        gone = np.setdiff1d(old, slots).astype(np.int32)
        other_kind = slots[(table.kind[slots] != EMPTY) & (table.kind[slots] != kind)]
        gone = np.union1d(gone, other_kind).astype(np.int32)
        kernels.link(gone, np.full(len(gone), -1, np.int32), table.root, table.first, table.next)
        table.kind[gone] = EMPTY
        return slots, keep

    def _link_observations(self, slots: I32) -> None:
        """Link observations to the landmarks they name, or later if those have not been received yet."""
        table = self.keypoints
        slots = slots[table.kind[slots] == OBSERVATION]
        named = self.find_landmarks(table.landmark[slots])
        roots = np.full(len(slots), -1, np.int32)
        known = named >= 0
        target = named[known]
        # A fused landmark leads to its root; one whose record has not been received yet is its own root.
        fused = (table.kind[target] == LANDMARK) & (table.root[target] >= 0)
        roots[known] = np.where(fused, table.root[target], target)
        kernels.link(slots, roots, table.root, table.first, table.next)
        for slot in slots[~known].tolist():
            anchor = KeyframeId(int(table.landmark[slot]) >> KEYPOINT_BITS)
            if anchor not in self.rows:
                slots_of_anchor = self._waiting.get(anchor)
                if slots_of_anchor is None:
                    if len(self._waiting) >= _MOST_WAITED_FOR:
                        continue
                    slots_of_anchor = self._waiting[anchor] = {}
                slots_of_anchor[slot] = None

    def _refresh_usable(self, row: int) -> None:
        table = self.keypoints
        start = int(self.keyframes.start[row])
        mine = slice(start, start + int(self.keyframes.count[row]))
        open_ = self.keyframes.culled[row] == 0 and self.keyframes.pose_source[row] != NO_POSE
        open_ &= self.keyframes.camera[row, 0] > 0.0  # else its camera is still to come
        here = table.kind[mine] != EMPTY
        table.usable[mine] = here & (table.flags[mine] & REMOVED == 0) & open_
        self.keyframes.usable[row] = np.count_nonzero(table.usable[mine])
        self.keyframes.live[row] = self.live_in(row)
        filled = int(np.count_nonzero(here))
        submap = submap_of_keyframe(KeyframeId(int(self.keyframes.id[row])))
        self.keypoints_of[submap] = self.keypoints_of.get(submap, 0) + filled - int(self.keyframes.filled[row])
        self.keyframes.filled[row] = filled

    def _compose(self, row: int) -> None:
        """Set a pose from the parent's, and the poses of descendants that are composed from it."""
        table = self.keyframes
        parent = KeyframeId(int(table.parent[row]))
        T_m_k = table.T_p_k[row]
        if parent != NO_KEYFRAME:
            above = self.rows.get(parent)
            if above is None or table.pose_source[above] == NO_POSE:
                return
            T_m_k = table.T_m_k[above] @ T_m_k
        if not self._put_pose(row, T_m_k):
            return
        table.pose_source[row] = COMPOSED
        self._refresh_usable(row)
        self._compose_children(KeyframeId(int(table.id[row])))

    def _put_pose(self, row: int, T_m_k: F64) -> bool:
        """Set the pose (4,4) of a keyframe; False, and it stays as it is, if that is too far off."""
        if not is_near(T_m_k):
            self.far_poses += 1
            return False
        self.keyframes.T_m_k[row] = T_m_k
        self._update_world_pose(row)
        return True

    def _update_world_pose(self, row: int) -> None:
        """Set T_w_k and scale of a keyframe from T_m_k and the pose of its submap."""
        table = self.keyframes
        self.moved_rows.add(row)
        submap = submap_of_keyframe(KeyframeId(int(table.id[row])))
        S_w_m, scale = self.submap_poses.get(submap), self._scales.get(submap, 1.0)
        table.scale[row] = scale
        table.T_w_k[row] = table.T_m_k[row] if S_w_m is None else S_w_m @ table.T_m_k[row]
        if scale != 1.0:
            table.T_w_k[row, :3, :3] /= scale

    def _update_world_poses(self, submap: SubmapId, rows: I32) -> None:
        """The same for keyframes of one submap."""
        self.moved_rows.update(rows.tolist())
        place_in_world(self.keyframes, rows, self.submap_poses.get(submap), self._scales.get(submap, 1.0))

    def _compose_children(self, keyframe: KeyframeId) -> None:
        table = self.keyframes
        open_ = [keyframe]
        while open_:
            above = open_.pop()
            for row in self._children.get(above, []):
                if table.pose_source[row] == REFINED_POSE:
                    continue
                if not self._put_pose(row, table.T_m_k[self.rows[above]] @ table.T_p_k[row]):
                    continue
                if table.pose_source[row] == NO_POSE:
                    table.pose_source[row] = COMPOSED
                    self._refresh_usable(row)
                open_.append(KeyframeId(int(table.id[row])))

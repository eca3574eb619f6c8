"""Corrections of the base that wait until they matter: those of one keyframe at their newest value.

Poses of the base fit each other. Where it has not set one, both sides compose what the agent told. A changed disparity
offset moves keyframes here, and the base does not know: from then on a part of its poses would tear the map, and those
that it computed before would undo the change.
"""

from dataclasses import dataclass, field

import numpy as np

from kiteline_agent.local_map.offset_history import OffsetHistory
from kiteline_codec.schema import CulledLandmarks, RemovedObservations
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, SEQUENCE_BITS, KeyframeId, SubmapId, keyframe_id

Removed = RemovedObservations | CulledLandmarks

_MOST_KNOWN = 1024  # keyframes of which it is known whether the base has placed them: many local maps
_NEWEST_KNOWN = 256


@dataclass(slots=True)
class HeldCorrections:
    """Of keyframes of the local map: poses (4,4), refined landmarks (index, rho, bearing), landmarks to remove.

    placed: keyframes whose pose the base has set, in the map or lately in it. moved: those that it has not, and that
    the agent moved since it told them; of submaps in `moved_submaps`. offsets: the changes that moved them. adapted: of
    how many changes poses and landmarks know that are held, by keyframe; those that the base told last are not in it.
    """

    poses: dict[KeyframeId, F64] = field(default_factory=dict)
    landmarks: dict[KeyframeId, tuple[I64, F64, F64]] = field(default_factory=dict)
    removed: dict[tuple[KeyframeId, int], Removed] = field(default_factory=dict)  # by keyframe and kind of the record
    placed: set[int] = field(default_factory=set)
    moved: set[int] = field(default_factory=set)
    moved_submaps: set[SubmapId] = field(default_factory=set)
    offsets: OffsetHistory = field(default_factory=OffsetHistory)
    adapted: dict[KeyframeId, int] = field(default_factory=dict)
    adapted_landmarks: dict[KeyframeId, int] = field(default_factory=dict)

    def set_pose(self, keyframe: KeyframeId, T_m_k: F64, *, stored: bool) -> None:
        """Take in a pose of the base. stored: the keyframe is in the local map."""
        self.placed.add(keyframe)
        self.moved.discard(keyframe)
        if stored:
            self.poses[keyframe] = T_m_k
            self.adapted.pop(keyframe, None)

    def set_landmarks(self, keyframe: KeyframeId, index: I64, rho: F64, bearing: F64) -> None:
        """Take in refined landmarks of the base: (n,), inverse depths (n,) 1/m and bearings (n,2)."""
        self.landmarks[keyframe] = index, rho, bearing
        self.adapted_landmarks.pop(keyframe, None)

    def adapt(self, keyframe: I64, parent: I64, T_m_k: F64, bf: float, least_rho: float) -> None:
        """Move what waits by the changes of the disparity offset that the base did not know when it told them.

        keyframe, parent (k,), T_m_k (k,4,4): of the local map. bf: focal length in px times baseline in m.
        least_rho: smallest inverse depth of a landmark, 1/m.
        """
        n = len(self.offsets)
        if n == 0:
            return
        parents = dict(zip(keyframe.tolist(), parent.tolist(), strict=True))
        here = dict(zip(keyframe.tolist(), T_m_k, strict=True))
        told = {int(k): T for k, T in self.poses.items() if k not in self.adapted and k in here}
        known = self.offsets.known_to_base(told, here, parents)
        for k, T in self.poses.items():
            if (of := self.adapted.get(k, known)) < n:
                self.poses[k] = se3.orthonormalise(self.offsets.moved(T, k, of, parents))
            self.adapted[k] = n
        for k, (index, rho, bearing) in self.landmarks.items():
            if (of := self.adapted_landmarks.get(k, known)) < n:
                rho = np.maximum(rho - self.offsets.disparity_px(bearing, of) / bf, least_rho)
                self.landmarks[k] = index, rho, bearing
            self.adapted_landmarks[k] = n

    def note_motion(self, submap: SubmapId, keyframe: I64, parent: I64, T_m_k: F64) -> None:
        """The agent is about to move the keyframes of a submap. keyframe, parent (k,), T_m_k (k,4,4): of the local map.

        What the base set is held once more, so that it returns with what the base sets next. `offsets` is told after.
        """
        self.moved_submaps.add(submap)
        self.placed.add(keyframe_id(submap, 0))  # it defines the submap
        for slot in np.flatnonzero(keyframe >> SEQUENCE_BITS == submap).tolist():
            k = KeyframeId(int(keyframe[slot]))
            if parent[slot] == NO_KEYFRAME:
                continue
            if k in self.placed:
                if k not in self.poses:
                    self.poses[k], self.adapted[k] = T_m_k[slot].copy(), len(self.offsets)
            else:
                self.moved.add(k)

    def fit(self, keyframe: I64, parent: I64) -> bool:
        """True if the poses that wait fit what would stay of a local map of keyframes (k,) with parents (k,)."""
        if not self.moved_submaps:
            return True
        parents = dict(zip(keyframe.tolist(), parent.tolist(), strict=True))
        return all(self._fits(k, parents) for k in self.poses)

    def _fits(self, keyframe: int, parents: dict[int, int]) -> bool:
        """True if all from a keyframe up to the newest ancestor that the base has set lie as the base composes them."""
        if keyframe >> SEQUENCE_BITS not in self.moved_submaps:
            return True
        while (above := parents.get(keyframe, NO_KEYFRAME)) != NO_KEYFRAME:
            if above in self.placed:
                if KeyframeId(above) not in self.poses:
                    return True
            elif above in self.moved or above not in parents:
                return False
            keyframe = above
        return True

    def forget(self, keyframe: KeyframeId) -> None:
        """Drop those of a keyframe that leaves the local map."""
        for held in (self.poses, self.landmarks, self.adapted, self.adapted_landmarks):
            held.pop(keyframe, None)
        for kind in (RemovedObservations.KIND, CulledLandmarks.KIND):
            self.removed.pop((keyframe, kind), None)

    def forget_evicted(self, keyframe: I64, parent: I64) -> None:
        """Drop what is known of keyframes that were evicted long ago, if that is much.

        keyframe, parent (k,): of the local map; what is asked later is of them, or of newer keyframes.
        """
        for known in (self.placed, self.moved):
            if len(known) > _MOST_KNOWN:
                kept = {*keyframe.tolist(), *parent.tolist(), *sorted(known)[-_NEWEST_KNOWN:]}
                known.intersection_update(kept)

    def clear(self) -> None:
        """Drop all: they were taken over."""
        for held in (self.poses, self.landmarks, self.adapted, self.adapted_landmarks, self.removed):
            held.clear()

"""The reference keyframe: the newest one that is shared, or the one at which the camera was relocalised.

Beside it the newest of all is known: where a link carries fewer keyframes than tracking needs, some are not shared.
"""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.keyframes.policy import KeyframeNeed, coverage, keyframe_need, situation
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import MAX_KEYFRAMES, NO_KEYFRAME, KeyframeId, SubmapId, keyframe_id, submap_of_keyframe

_COVER_S = 2.0  # s over which the usual cover is a mean
_MOST_COVER = 0.2  # weight of a frame in it at most: the first one after a loss may still be hidden in part
_UNSHARED = 1024  # sequence numbers of keyframes that are not shared, used in turn: many times those in a local map
_LAST = MAX_KEYFRAMES - _UNSHARED - 1  # the highest sequence number of a keyframe that is shared
# Sequence number at which a submap is full, after 6 hours at 2.8 keyframes a second. Some are left for keyframes that
# losses and returns to it ask for.
FULL_AT = _LAST - 512


@dataclass(slots=True)
class _Made:
    """When a keyframe was made. inliers, cover (see `Situation`): of the first frame that was tracked after it."""

    keyframe: KeyframeId = NO_KEYFRAME
    t_ns: int = 0
    frame_number: int = 0
    inliers: int = 0
    cover: float = 1.0


class ReferenceKeyframe:
    """The keyframe relative to which the pose is reported. T_k_c: (4,4) camera in it, as the base holds it.

    What is shared is relative to keyframes as the base composes them, so that their rounding does not add up.
    """

    def __init__(self, local_map: LocalMap) -> None:
        self._map = local_map
        self._last_sequence: dict[SubmapId, int] = {}  # of the newest keyframe that is shared in each submap
        self._shared = _Made()  # the newest keyframe that is shared; its inliers are those of shared landmarks
        self._newest = _Made()  # the newest one, shared or not
        self._unshared = 0  # number of keyframes that were not shared
        self.keyframe: KeyframeId = NO_KEYFRAME
        self.T_k_c: F64 = np.eye(4)
        self.usual_cover = 0.0  # share of coarse image cells with a tracked landmark, mean of the last seconds
        self._covered_ns: int | None = None  # stamp of the newest frame in that mean
        self._rounding: F64 = np.eye(4)  # the keyframe as the base holds it, in the keyframe of the local map

    @property
    def T_m_k(self) -> F64 | None:
        """(4,4) in the local map, as the base holds it; None if the keyframe was evicted."""
        slot = self._map.slot_of(self.keyframe)
        if slot < 0:
            return None
        T_m_k: F64 = self._map.T_m_k[slot]
        return T_m_k if self._map.from_base[slot] else T_m_k @ self._rounding

    def _pose_of(self, keyframe: KeyframeId) -> F64 | None:
        slot = self._map.slot_of(keyframe)
        return self._map.T_m_k[slot] if slot >= 0 else None

    def set_camera(self, T_m_c: F64) -> None:
        """Update T_k_c from the camera's pose (4,4)."""
        T_m_k = self.T_m_k
        if T_m_k is not None:
            self.T_k_c = se3.inverse(T_m_k) @ T_m_c

    def keyframe_need(self, ctx: FrameContext, track: Track) -> KeyframeNeed | None:
        """Why a tracked frame should become a keyframe; None if it need not.

        After a keyframe that was not shared, another such one serves the tracker: what presses is that the base's
        landmarks leave the view.
        """
        if self._last_sequence.get(submap_of_keyframe(self.keyframe), 0) >= _LAST:
            return None  # no ids are left, in this submap and of further submaps
        unshared = self._newest.keyframe != self._shared.keyframe
        cover = coverage(track.observed[track.inlier, :2], self._map.camera)
        self._note_cover(cover, ctx.t_ns)
        frames, of_base = ctx.number - self._newest.frame_number, self._of_base(track)
        if frames == 1:
            self._newest.inliers, self._newest.cover = track.inliers, cover
        if ctx.number - self._shared.frame_number == 1:
            self._shared.inliers = of_base
        T_m_k = self._pose_of(self._newest.keyframe) if unshared else None
        T_m_k = self._pose_of(self.keyframe) if T_m_k is None else T_m_k
        assert T_m_k is not None
        age_s = (ctx.t_ns - self._newest.t_ns) * 1e-9
        now = situation(track, T_m_k, frames, age_s, self._newest.inliers, cover, self._newest.cover)
        need = keyframe_need(now, ctx.config.keyframe)
        if need is None or not unshared:
            return need
        return replace(need, pressing=of_base < ctx.config.keyframe.min_share * self._shared.inliers)

    def _note_cover(self, cover: float, t_ns: int) -> None:
        share = 1.0 if self._covered_ns is None else min(_MOST_COVER, (t_ns - self._covered_ns) * 1e-9 / _COVER_S)
        self.usual_cover += share * (cover - self.usual_cover)
        self._covered_ns = t_ns

    def _of_base(self, track: Track) -> int:
        """Number of tracked landmarks that are shared with the base."""
        return int(np.count_nonzero(self._map.is_shared(track.rows[track.inlier])))

    def age_ns(self, t_ns: int) -> int:
        """Time since the newest keyframe that is shared."""
        return t_ns - self._shared.t_ns

    def next_keyframe(self, submap: SubmapId, T_m_c: F64) -> tuple[KeyframeId, KeyframeId, F64]:
        """Id, parent and T_p_k (4,4) of the next keyframe; a submap's first one has no parent, its pose is T_m_c.

        T_p_k is made orthonormal: poses composed along the parents would double what it is off with each keyframe.
        """
        if submap not in self._last_sequence:
            return keyframe_id(submap, 0), NO_KEYFRAME, T_m_c
        return keyframe_id(submap, self._last_sequence[submap] + 1), self.keyframe, se3.orthonormalise(self.T_k_c)

    def is_full(self, submap: SubmapId) -> bool:
        """True if the sequence numbers of a submap are used up, but for some."""
        return self._last_sequence.get(submap, 0) >= FULL_AT

    def next_unshared(self, submap: SubmapId) -> KeyframeId:
        """Id of the next keyframe that is not shared: from the end of the sequence numbers, where no other ones are."""
        return keyframe_id(submap, MAX_KEYFRAMES - 1 - self._unshared % _UNSHARED)

    def set_new(
        self, keyframe: KeyframeId, submap: SubmapId, T_m_c: F64, T_m_k: F64, t_ns: int, frame_number: int
    ) -> None:
        """A keyframe was made of the camera at T_m_c (4,4). T_m_k: (4,4) as the base holds it."""
        self._last_sequence[submap] = self._last_sequence.get(submap, -1) + 1
        self.keyframe, self.T_k_c = keyframe, se3.inverse(T_m_k) @ T_m_c
        self._rounding = se3.inverse(self.T_k_c)
        self._shared = _Made(keyframe, t_ns, frame_number, self._shared.inliers)
        self._newest = _Made(keyframe, t_ns, frame_number, self._newest.inliers, self._newest.cover)

    def set_unshared(self, keyframe: KeyframeId, t_ns: int, frame_number: int) -> None:
        """A keyframe was made that is not shared."""
        self._unshared += 1
        self._newest = _Made(keyframe, t_ns, frame_number, self._newest.inliers, self._newest.cover)

    def is_of(self, frame_number: int) -> bool:
        """True if the newest keyframe that is shared was made of this frame."""
        return self._shared.frame_number == frame_number

    @property
    def is_newest(self) -> bool:
        """True if no older keyframe is the reference, after a relocalisation."""
        return self.keyframe == self._shared.keyframe

    def return_to(self, keyframe: KeyframeId, inliers: int, frame_number: int) -> None:
        """Use a keyframe after a relocalisation, mostly the same; `set_camera` follows."""
        if keyframe != self.keyframe:
            self.keyframe, self._rounding = keyframe, np.eye(4)
        self._newest = replace(self._shared, inliers=inliers)
        self._shared.inliers = inliers
        self._map.last_seen[self._map.slot_of(keyframe)] = frame_number

    def scale_inliers(self, points_before: int, points_now: int) -> None:
        """Frames track another number of landmarks from now on: keep the reference comparable."""
        for made in (self._shared, self._newest):
            made.inliers = made.inliers * points_now // points_before

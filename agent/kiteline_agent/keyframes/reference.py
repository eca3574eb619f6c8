"""The reference keyframe: the newest one, or the one at which the camera was relocalised."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.keyframes.policy import KeyframeNeed, keyframe_need, situation
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId, keyframe_id

F64 = NDArray[np.float64]


class ReferenceKeyframe:
    """The keyframe relative to which the pose is reported. T_k_c: (4,4) camera in it."""

    def __init__(self, local_map: LocalMap) -> None:
        self._map = local_map
        self._last_sequence: dict[SubmapId, int] = {}  # of the newest keyframe in each submap
        self._inliers = 0  # of the first frame that was tracked after the newest keyframe
        self._t_ns = 0  # of the newest keyframe
        self._frame_number = 0
        self.keyframe: KeyframeId = NO_KEYFRAME
        self.T_k_c: F64 = np.eye(4)

    @property
    def T_m_k(self) -> F64 | None:
        """(4,4) in the local map; None if the keyframe was evicted."""
        slot = self._map.slot_of(self.keyframe)
        return self._map.T_m_k[slot] if slot >= 0 else None

    def set_camera(self, T_m_c: F64) -> None:
        """Update T_k_c from the camera's pose (4,4)."""
        T_m_k = self.T_m_k
        if T_m_k is not None:
            self.T_k_c = se3.inverse(T_m_k) @ T_m_c

    def keyframe_need(self, ctx: FrameContext, track: Track) -> KeyframeNeed | None:
        """Why a tracked frame should become a keyframe; None if it need not."""
        frames = ctx.number - self._frame_number
        if frames == 1:
            self._inliers = track.inliers
        T_m_k = self.T_m_k
        assert T_m_k is not None
        now = situation(track, self._map.camera, T_m_k, frames, self.age_ns(ctx.t_ns) * 1e-9, self._inliers)
        return keyframe_need(now, ctx.config.keyframe)

    def age_ns(self, t_ns: int) -> int:
        """Time since the newest keyframe."""
        return t_ns - self._t_ns

    def next_keyframe(self, submap: SubmapId, T_m_c: F64) -> tuple[KeyframeId, KeyframeId, F64]:
        """Id, parent and T_p_k (4,4) of the next keyframe; a submap's first one has no parent, its pose is T_m_c."""
        if submap not in self._last_sequence:
            return keyframe_id(submap, 0), NO_KEYFRAME, T_m_c
        return keyframe_id(submap, self._last_sequence[submap] + 1), self.keyframe, self.T_k_c

    def set_new(self, keyframe: KeyframeId, submap: SubmapId, T_k_c: F64, t_ns: int, frame_number: int) -> None:
        """A keyframe was made. T_k_c: (4,4), not exactly the identity, since the keyframe's pose is quantised."""
        self._last_sequence[submap] = self._last_sequence.get(submap, -1) + 1
        self.keyframe, self.T_k_c = keyframe, T_k_c
        self._t_ns, self._frame_number = t_ns, frame_number

    def is_of(self, frame_number: int) -> bool:
        """True if the newest keyframe was made of this frame."""
        return self._frame_number == frame_number

    def return_to(self, keyframe: KeyframeId, inliers: int, frame_number: int) -> None:
        """Use an older keyframe after a relocalisation; `set_camera` follows."""
        self.keyframe = keyframe
        self._inliers = inliers
        self._map.last_seen[self._map.slot_of(keyframe)] = frame_number

    def scale_inliers(self, points_before: int, points_now: int) -> None:
        """Frames track another number of landmarks from now on: keep the reference comparable."""
        self._inliers = self._inliers * points_now // points_before

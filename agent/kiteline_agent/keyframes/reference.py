"""The reference keyframe, relative to which the pose is told, and when the next keyframe takes its place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.keyframes import policy
from kiteline_agent.keyframes.keyframe_maker import KeyframeMaker
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.tracker import FrameImages, Track
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId, keyframe_id

F64 = NDArray[np.float64]


class ReferenceKeyframe:
    """The newest keyframe, or the one where an old map was found again. T_k_c: (4,4) the camera in it."""

    def __init__(self, local_map: LocalMap, camera: RectifiedCamera, maker: KeyframeMaker) -> None:
        self._map = local_map
        self._camera = camera
        self._maker = maker
        self._sequence: dict[SubmapId, int] = {}  # how many keyframes after the first each submap has
        self._inliers = 0  # of the first frame that was tracked after it
        self._t_ns = 0  # of the newest keyframe
        self._frame = 0
        self.keyframe: KeyframeId = NO_KEYFRAME
        self.T_k_c: F64 = np.eye(4)

    @property
    def T_m_k(self) -> F64 | None:
        """(4,4) as the local map has it now; None where it has forgotten the keyframe."""
        slot = self._map.slot_of(self.keyframe)
        return self._map.T_m_k[slot] if slot >= 0 else None

    def refresh(self, T_m_c: F64) -> None:
        """The camera is at T_m_c (4,4)."""
        T_m_k = self.T_m_k
        if T_m_k is not None:
            self.T_k_c = se3.inverse(T_m_k) @ T_m_c

    def asks(self, track: Track, t_ns: int, frame: int, config: AgentConfig, gap_ns: int) -> policy.Wish | None:
        """Whether a tracked frame should become a keyframe. gap_ns: between keyframes, that the link can carry."""
        if frame - self._frame == 1:
            self._inliers = track.inliers
        T_m_k = self.T_m_k
        assert T_m_k is not None
        what = policy.situation(
            track, self._camera, T_m_k, frame - self._frame, (t_ns - self._t_ns) * 1e-9, self._inliers
        )
        why = policy.why_keyframe(what, config.keyframe)
        if why is None:
            return None
        waits = t_ns - self._t_ns < gap_ns and policy.may_wait(what, config.keyframe)
        thin = track.inliers < config.keyframe.thin * config.pose.min_inliers
        return policy.Wish(why, urgent=thin, waits=waits)

    def add(self, view: FrameImages, track: Track | None, t_ns: int, frame: int, submap: SubmapId, T_m_c: F64) -> None:
        """Make a keyframe of this frame. Without a track it sees nothing again; a submap's first one begins it."""
        begins = submap not in self._sequence
        parent, T_p_k = (NO_KEYFRAME, T_m_c) if begins else (self.keyframe, self.T_k_c)
        sequence = 0 if begins else self._sequence[submap] + 1
        self._sequence[submap] = sequence
        keyframe = keyframe_id(submap, sequence)
        T_m_k = self._maker.make(view, track, keyframe, t_ns, parent, T_p_k, frame)
        # The keyframe lies where its code says, a rounding away from the camera.
        self.keyframe, self.T_k_c = keyframe, se3.inverse(T_m_k) @ T_m_c
        self._t_ns, self._frame = t_ns, frame

    def is_of(self, frame: int) -> bool:
        """Whether the newest keyframe was made of this frame."""
        return self._frame == frame

    def move_to(self, keyframe: KeyframeId, inliers: int, frame: int) -> None:
        """Go on from a keyframe where the old map was found; `refresh` says where the camera is in it."""
        self.keyframe = keyframe
        self._inliers = inliers
        self._map.last_seen[self._map.slot_of(keyframe)] = frame

    def fewer_points(self, before: int, now: int) -> None:
        """Frames try so many points now: what the reference saw is judged alike."""
        self._inliers = self._inliers * now // before

"""Makes keyframes of frames, and enters them in all that reads keyframes."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from kiteline_agent.governor.cost_model import Work
from kiteline_agent.governor.governor import Extra, Governor
from kiteline_agent.keyframes.keyframe_maker import KeyframeMaker
from kiteline_agent.keyframes.new_landmarks import EarlierView, NewPoints
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.relocalisation.relocaliser import Relocaliser
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_codec.channel import RecordChannel
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId

_WAIT_DEPTH_S = 0.26  # s that a keyframe waits for a lost right or depth image; slow depth cameras have 5 a second
_DEAD_RECKONING_RAD = 0.02  # rad: standard deviation up to which dead reckoning extends the map, a degree
_THIN_TRACK = 3.0  # times the fewest inliers of a pose; with fewer a keyframe does not wait for CPU time
_SHOWS_LESS = 0.7  # of the share of landmarks that the frame before showed; motion alone hardly leaves less


class KeyframeStage:
    """Keyframe policy, with what the link carries and CPU time allows, and the making of keyframes."""

    def __init__(
        self, camera: CameraState, maker: KeyframeMaker, relocaliser: Relocaliser, governor: Governor,
        channel: RecordChannel, work: Work,
    ) -> None:  # fmt: skip
        self._camera = camera
        self._maker = maker
        self._relocaliser = relocaliser
        self._governor = governor
        self._channel = channel
        self._work = work
        self._depth_t_ns = 0  # of the last frame whose images measure depth
        self._found = 0.0  # share of the landmarks searched for that the last tracked frame showed

    def add_if_needed(self, ctx: FrameContext, track: Track) -> list[str]:
        """Make a keyframe if the policy needs one and CPU time allows it; share it if the link does. Returns events.

        Inertial steps between earlier keyframes are shared first, if their samples have come.
        """
        if not self._maker.lacks_depth(ctx):
            self._depth_t_ns = ctx.t_ns
        self._share_steps()
        shows_less = self._shows_less(track)
        need = self._camera.reference.keyframe_need(ctx, track)
        if need is None:
            return []
        urgent = track.inliers < _THIN_TRACK * ctx.config.pose.min_inliers
        if not self._governor.may(Extra.KEYFRAME, urgent=urgent):
            return ["governor: keyframe postponed"]
        if not urgent and 0.0 < (ctx.t_ns - self._depth_t_ns) * 1e-9 < _WAIT_DEPTH_S:
            return []  # its new landmarks would have no depth
        if not urgent and shows_less:
            return []  # its new landmarks would be what is wrong with it; if it was not the image, the next frame does
        if not need.pressing and self._camera.reference.age_ns(ctx.t_ns) < self._channel.keyframe_gap_ns():
            self._add_unshared(ctx, track)
            return [f"keyframe, not shared: {need.rule}"]
        self.add(ctx, track)
        return [f"keyframe: {need.rule}"]

    def _shows_less(self, track: Track) -> bool:
        """True for a frame that shows much less of the map than the one before: covered, blurred or torn."""
        before, self._found = self._found, track.inliers / max(track.tried, 1)
        return self._found < _SHOWS_LESS * before

    def add(self, ctx: FrameContext, track: Track) -> None:
        """Make a keyframe of a tracked frame, with new landmarks where the image has room."""
        points = self._maker.points_beside(ctx, track)
        self.make(ctx, track, points, self._camera.pose.T_m_c, Extra.KEYFRAME)

    def _share_steps(self) -> None:
        """Share the inertial steps between keyframes whose samples have come."""
        for steps in self._camera.motion.take_steps():
            if self._channel.profile.inertial_steps:
                self._channel.put(steps)

    def _add_unshared(self, ctx: FrameContext, track: Track) -> None:
        """Make a keyframe for the tracker alone."""
        camera, reference = self._camera, self._camera.reference
        keyframe = reference.next_unshared(camera.submaps.active)
        points = self._maker.points_beside(ctx, track)
        self._maker.make_unshared(ctx, points, camera.pose.T_m_c, keyframe, reference.keyframe)
        reference.set_unshared(keyframe, ctx.t_ns, ctx.number)
        self._finish(ctx, keyframe, Extra.KEYFRAME)

    def extend_map_by_dead_reckoning(self, ctx: FrameContext) -> tuple[bool, list[str]]:
        """Make a keyframe without observations, where dead reckoning says that the camera is.

        Returns whether the map goes on there, also if the keyframe has to wait for CPU time, and events.
        """
        limits = ctx.config.relocalisation
        if not self._camera.covariance.dead_reckoning_within(limits.dead_reckoning_m, _DEAD_RECKONING_RAD):
            return False, []
        if not self._governor.may(Extra.KEYFRAME, urgent=True):
            return True, ["governor: keyframe postponed"]
        points = self._maker.first_points(ctx)
        if points is None:
            return False, []
        self._camera.covariance.extend_map(self._camera.T_m_b)
        self.make(ctx, None, points, self._camera.pose.T_m_c, Extra.KEYFRAME)
        return True, ["keyframe: by dead reckoning"]

    def make(self, ctx: FrameContext, track: Track | None, points: NewPoints, T_m_c: F64, kind: Extra) -> KeyframeId:
        """Make a keyframe of a frame with the camera at T_m_c (4,4); it becomes the reference.

        track: see KeyframeMaker.
        """
        reference, submap = self._camera.reference, self._camera.submaps.active
        keyframe, parent, T_p_k = reference.next_keyframe(submap, T_m_c)
        T_m_p = reference.T_m_k
        T_p_k = self._maker.make(ctx, track, points, T_m_c, keyframe, parent, T_p_k, self._camera.motion.up())
        self._camera.motion.mark_keyframe(keyframe, ctx.t_ns)
        self._share_steps()
        T_m_k = T_p_k if parent == NO_KEYFRAME else T_m_c if T_m_p is None else se3.orthonormalise(T_m_p @ T_p_k)
        reference.set_new(keyframe, submap, T_m_c, T_m_k, ctx.t_ns, ctx.number)
        self._relocaliser.add_keyframe(keyframe)
        self._finish(ctx, keyframe, kind)
        return keyframe

    def share_earlier(self, ctx: FrameContext, views: Sequence[EarlierView]) -> None:
        """Share keyframes of what the camera saw before this frame, the first one of a map."""
        reference, submap, T_m_c = self._camera.reference, self._camera.submaps.active, self._camera.pose.T_m_c
        poses = [*(T_m_c @ view.T_n_k for view in views), T_m_c]
        landmarks: dict[int, int] = {}
        T_m_p = np.eye(4)
        for view, (T_m_k, T_m_next) in zip(views, pairwise(poses), strict=True):
            keyframe, parent, T_p_k = reference.next_keyframe(submap, T_m_k)
            T_m_p = se3.orthonormalise(T_m_p @ self._maker.share(ctx, view, keyframe, parent, T_p_k, landmarks))
            reference.set_new(keyframe, submap, T_m_next, T_m_p, view.t_ns, ctx.number)

    def _finish(self, ctx: FrameContext, keyframe: KeyframeId, kind: Extra) -> None:
        self._governor.note(kind)
        self._camera.covariance.store(keyframe)
        if ctx.images.right is not None and ctx.images.right.needs_rectification:
            self._work.rectified_px += ctx.images.sampled[1].size

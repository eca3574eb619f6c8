"""Tracks a frame in the local map: from the predicted pose, then from other guesses if most landmarks were missed."""

from kiteline_agent.governor.governor import Extra, Governor
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.relocalisation.relocaliser import Relocaliser
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.image_shift import ImageShift
from kiteline_agent.tracking.track import Track
from kiteline_agent.tracking.tracker import Tracker
from kiteline_core.geometry.cameras import Rectifier


class TrackStage:
    """Call `track` once a frame, and `remember` if the frame has a pose from its images."""

    def __init__(
        self, camera: CameraState, tracker: Tracker, relocaliser: Relocaliser, governor: Governor, rectifier: Rectifier
    ) -> None:
        self._camera = camera
        self._tracker = tracker
        self._relocaliser = relocaliser
        self._governor = governor
        self._image_shift = ImageShift(rectifier)

    def remember(self, ctx: FrameContext) -> None:
        """Keep the image of a frame that was tracked."""
        self._image_shift.remember(ctx.images.sampled, self._camera.pose.T_c_m)

    def track(self, ctx: FrameContext, *, was_lost: bool) -> Track | None:
        """The track of a frame; None if its pose is not credible. was_lost: the frame before was not tracked."""
        config, camera = ctx.config.pose, self._camera
        # a. From the prediction.
        by_imu = camera.motion.running and not was_lost
        near = self._tracker.track_by_imu(ctx) if by_imu else None
        track = self._tracker.track(ctx, ctx.T_c_m) if near is None else near
        # b. From rotations that bring the last image onto this one.
        if not track.holds(config):
            track = self._from_rotations(ctx, track)
        # c. From steps along the axis, while nothing has told the speed.
        if not (track.holds(config) or was_lost or camera.knows_motion) and self._governor.may(Extra.SEARCH):
            track = _better(track, self._tracker.track_along_axis(ctx, camera.pose.T_c_m))
        # d. From matched descriptors.
        if not track.holds(config) and track.inliers >= config.min_inliers and self._governor.may(Extra.SEARCH):
            found = self._from_descriptors(ctx, track)
            if found is not track and was_lost and camera.covariance.far_relocalisation:  # the loss stage decides
                return None
            track = found
        submap = camera.submaps.active
        if track.inliers < config.min_inliers or not camera.is_consistent(ctx, track.T_c_m, submap, relocalised=False):
            return None
        return self._tracker.nearer(ctx, track) if by_imu and near is None else track

    def _from_rotations(self, ctx: FrameContext, track: Track) -> Track:
        """The better of a track and those from the rotations that the image tells, until one holds."""
        for number, T_c_m in enumerate(self._image_shift.rotated_poses(ctx.images.sampled)):
            if track.holds(ctx.config.pose) or (number > 0 and not self._governor.may(Extra.SEARCH)):
                break
            track = _better(track, self._tracker.track(ctx, T_c_m))
        return track

    def _from_descriptors(self, ctx: FrameContext, track: Track) -> Track:
        found = self._relocaliser.relocalise(ctx, self._camera.reference.keyframe)
        if found is None or found.submap != self._camera.submaps.active or found.track.inliers < track.inliers:
            return track
        return found.track


def _better(track: Track, other: Track) -> Track:
    return other if other.inliers > track.inliers else track

"""Handles a frame that was not tracked: dead reckoning, relocalisation, or a new submap."""

from dataclasses import dataclass

from kiteline_agent.governor.governor import Extra, Governor
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.mapping.keyframe_stage import KeyframeStage
from kiteline_agent.mapping.submap_stage import SubmapStage
from kiteline_agent.relocalisation.relocaliser import Relocaliser
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_HIDDEN_S = 1.0  # s after which landmarks that cover little of the image are all that there is
_LEAST_COVER = 0.6  # of what landmarks covered in the seconds before


@dataclass(frozen=True, slots=True)
class FrameOutcome:
    """How a frame was placed. tracked: it has a pose. bridged: by dead reckoning alone. inliers: of the images.

    T_o_n: (4,4) odometry frame as it lies in the map after a relocalisation, n, seen from where it lay before, o: what
    dead reckoning was off by. None without a relocalisation, or in another submap.
    """

    tracked: bool
    bridged: bool
    inliers: int
    events: list[str]
    T_o_n: F64 | None = None


class LossStage:
    """Search for the map after a loss. failed_searches: since then, in frames with texture."""

    def __init__(
        self, camera: CameraState, keyframes: KeyframeStage, submaps: SubmapStage, relocaliser: Relocaliser,
        governor: Governor, *, monocular: bool,
    ) -> None:  # fmt: skip
        self._camera = camera
        self._keyframes = keyframes
        self._submaps = submaps
        self._relocaliser = relocaliser
        self._governor = governor
        self._monocular = monocular
        self.failed_searches = 0
        self._since_ns: int | None = None  # stamp of the first frame that was not placed

    def end(self) -> None:
        """A frame was tracked."""
        self.failed_searches, self._since_ns = 0, None
        self._submaps.note_tracked()

    def handle(self, ctx: FrameContext, *, stuck: bool, was_lost: bool) -> FrameOutcome:
        """Place a frame that was not tracked. stuck: its image is an old one. was_lost: nor was the frame before."""
        self._since_ns = ctx.t_ns if self._since_ns is None else self._since_ns
        events: list[str] = []
        # a. Dead reckoning places the camera, and extends the map while its covariance is small.
        bridged = self._camera.dead_reckon(ctx)
        if stuck:
            return FrameOutcome(bridged, bridged, 0, events)
        if bridged and not self._monocular:
            extended, events = self._keyframes.extend_map_by_dead_reckoning(ctx)
            if extended:
                return FrameOutcome(True, True, 0, events)
        # b. Relocalise in the stored submaps.
        submap, T_o_m = self._camera.submaps.active, self._camera.pose.T_o_m
        track, more = self._relocalise(ctx, was_lost=was_lost)
        events += more
        placed = track is not None
        T_o_n = None
        if placed and self._camera.submaps.active == submap:
            T_o_n = T_o_m @ se3.inverse(self._camera.pose.T_o_m)
        # c. Open a new submap.
        if not placed and self._submaps.may_open(self.failed_searches):
            opened = self._submaps.open(ctx, self._least_cover(ctx.t_ns - self._since_ns))
            if opened is not None:
                self.failed_searches = 0
                placed = opened.placed
                events += opened.events
            events += self._submaps.take_warnings()
        if placed:
            self._camera.motion.restart(ctx.t_ns)
            bridged, self._since_ns = False, None
        return FrameOutcome(placed or bridged, bridged, 0 if track is None else track.inliers, events, T_o_n)

    def _least_cover(self, lost_ns: int) -> float:
        """Share of the image that new landmarks cover at least. lost_ns: since the first frame that was not placed.

        If they cover much less than landmarks did before, something may hide the view for a moment.
        """
        if not self._camera.submaps.any or lost_ns >= _HIDDEN_S * 1e9:
            return 0.0
        return _LEAST_COVER * self._camera.reference.usual_cover

    def continue_start(self) -> tuple[FrameContext | None, FrameOutcome]:
        """Go on with the solution with which a monocular map begins, at the last frame; None while it does not."""
        opened, warnings = self._submaps.continue_start(), self._submaps.take_warnings()
        if opened is None:
            return None, FrameOutcome(False, False, 0, warnings)
        ctx, submap = opened
        self._camera.motion.restart(ctx.t_ns)
        return ctx, FrameOutcome(submap.placed, False, 0, submap.events + warnings)

    def _relocalise(self, ctx: FrameContext, *, was_lost: bool) -> tuple[Track | None, list[str]]:
        """Search the stored submaps; if the frame is found, continue there, with a keyframe. And events."""
        camera = self._camera
        if not camera.submaps.any:
            return None, []
        if not self._governor.may(Extra.SEARCH):
            self.failed_searches = max(self.failed_searches, 1)
            return None, ["governor: search postponed"]
        found = self._relocaliser.relocalise(ctx, camera.reference.keyframe)
        if found is None:
            self.failed_searches += self._relocaliser.has_texture
            return None, []
        if camera.images_measured_motion(found, was_lost=was_lost):
            camera.move_to(found, ctx)
        else:
            camera.return_to(found, ctx.number)
            camera.pose.reset_motion()
        self.failed_searches = 0
        if found.from_cache:  # none of its landmarks is in the local map yet
            self._keyframes.add(ctx, found.track)
            return found.track, ["relocalised by the map cache"]
        return found.track, ["relocalised", *self._keyframes.add_if_needed(ctx, found.track)]

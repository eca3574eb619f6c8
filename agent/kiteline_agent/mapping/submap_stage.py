"""Opens submaps, joins new ones to older ones, continues full ones, and restarts monocular ones in metres."""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.governor.governor import Extra, Governor
from kiteline_agent.inertial.imu_initialisation import InertialStartState
from kiteline_agent.inertial.inertial_tracker import InertialTracker
from kiteline_agent.initialisation.inertial_map import InertialMap
from kiteline_agent.initialisation.inertial_start import InertialStart
from kiteline_agent.initialisation.metric_restart import MetricPoints, metric_points
from kiteline_agent.initialisation.two_view_start import TwoViewStart
from kiteline_agent.initialisation.unscaled_path import UnscaledPath
from kiteline_agent.initialisation.window import lens_correction
from kiteline_agent.keyframes.depth_from_motion import DepthFromMotion
from kiteline_agent.keyframes.keyframe_maker import KeyframeMaker
from kiteline_agent.keyframes.pair_search import Fault
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.mapping.earlier_views import earlier_views
from kiteline_agent.mapping.keyframe_stage import KeyframeStage
from kiteline_agent.mapping.loss_tie import LossTie
from kiteline_agent.mapping.start_choice import StartChoice
from kiteline_agent.mapping.start_watch import VIEWS_S, StartWatch
from kiteline_agent.mapping.submaps import TRACKED_M, TRACKED_RAD
from kiteline_agent.mapping.told_unit import told_unit
from kiteline_agent.relocalisation.relocaliser import Relocaliser
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_agent.tracking.tracker import Tracker
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import SubmapScale, SubmapTie
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.ids import NO_KEYFRAME

_IGNORED = "imu: not used from here on: the images alone are flown, in a unit of length of their own, as with --no-imu"
_NO_METRES = "mono: lengths are not metres any more: nothing measured the motion while images were lost"
_FAILURES = 2  # failed searches in frames with texture before a new submap is opened
_SCALE_SIGMA = 0.02  # relative deviation below which the metric scale of two views is used
_SETTLED_S = 1.0  # s of images after some without; a map corrected sooner begins with the few landmarks found again


@dataclass(frozen=True, slots=True)
class OpenedSubmap:
    """A new submap. placed: the frame has a pose in it."""

    placed: bool
    events: list[str]


class SubmapStage:
    """Changes of the active submap. The starts are None with stereo or depth, inertial_start also without IMU."""

    def __init__(
        self, camera: CameraState, local_map: LocalMap, tracker: Tracker, maker: KeyframeMaker,
        keyframes: KeyframeStage, relocaliser: Relocaliser, depth: DepthFromMotion, two_view_start: TwoViewStart | None,
        inertial_start: InertialStart | None, governor: Governor, channel: RecordChannel, rectifier: Rectifier,
        corrections: Corrections,
    ) -> None:  # fmt: skip
        self._camera = camera
        self._rectifier = rectifier
        self._corrections = corrections
        self._map = local_map
        self._tracker = tracker
        self._maker = maker
        self._keyframes = keyframes
        self._relocaliser = relocaliser
        self._depth = depth
        self._two_view_start = two_view_start
        self._inertial_start = inertial_start
        self.start_choice = StartChoice(camera, inertial_start, has_time=not governor.on)
        self._governor = governor
        self._channel = channel
        self._path = UnscaledPath(local_map)
        self._tracked_number, self._tracked_since_ns = -1, 0  # the last tracked frame, and the first one without a gap
        self._loss_tie = LossTie(camera, channel)
        self._warnings: list[str] = []
        self._start_watch, self._views_watch = StartWatch(), StartWatch(VIEWS_S)

    def may_open(self, failed_searches: int) -> bool:
        """True if there is no map yet, or the search for the old one failed and ids and CPU time are left."""
        submaps = self._camera.submaps
        if not submaps.any:
            return True
        tried = failed_searches >= _FAILURES
        return tried and submaps.room and self._governor.may(Extra.SUBMAP)

    def open(self, ctx: FrameContext, least_cover: float = 0.0) -> OpenedSubmap | None:
        """Begin a submap with this frame; None if it shows too little.

        least_cover: share of the image that landmarks of a stereo or depth camera cover at least.
        """
        inertial, motion = self._inertial_start, self._camera.motion
        if inertial is not None and motion.tracker is not None:
            if inertial.add_samples(ctx) and self.start_choice.awaits_window(ctx.t_ns):
                return self._open_from_inertial_window(ctx, inertial, motion.tracker)
            inertial.clear()
        if self._two_view_start is not None:
            return self._open_from_two_views(ctx, self._two_view_start)
        points = self._maker.first_points(ctx, least_cover)
        self._warnings += self._start_watch.note(ctx.t_ns, None if points is not None else self._maker.fault)
        if points is None:
            return None
        camera = self._camera
        since, T_k_c = camera.reference.keyframe, camera.reference.T_k_c.copy()
        R_o_m = camera.pose.T_o_m[:3, :3]  # of the old submap
        after_loss = camera.submaps.any
        if after_loss:
            camera.leave_submap()
            self._relocaliser.start_joining(ctx.t_ns)
        else:
            camera.set_first_pose(ctx.imu)
        submap = camera.open_submap()
        camera.pose.reset_motion()
        self._keyframes.make(ctx, None, points, camera.pose.T_m_c, Extra.SUBMAP)
        if after_loss:
            self._loss_tie.begin(ctx.t_ns, since, T_k_c, submap, R_o_m)
        return OpenedSubmap(True, ["submap: opened"])

    def note_tracked(self) -> None:
        """A frame was tracked: what keeps a later map from beginning is counted anew."""
        self._start_watch.note(0, None)

    def take_warnings(self) -> list[str]:
        """Events since the last call: what keeps a map from beginning, or a monocular one from its scale."""
        warnings, self._warnings = self._warnings, []
        return warnings + ([] if self._inertial_start is None else self._inertial_start.take_warnings())

    def _open_from_inertial_window(
        self, ctx: FrameContext, start: InertialStart, inertial: InertialTracker
    ) -> OpenedSubmap | None:
        """Begin a monocular submap in metres at this frame; None until its scale is known.

        An IMU that certainly contradicts the images is ignored from then on; not one that agreed with them before.
        """
        found = start.add(ctx, inertial.known)
        if found is not None:
            return self._open_in_metres(found, start)
        if start.contradicted and not self._camera.submaps.any:
            self._ignore_imu(start)
        return None

    def _ignore_imu(self, start: InertialStart) -> None:
        self._camera.ignore_imu()
        self._warnings = [*start.take_warnings(), _IGNORED]

    def continue_start(self) -> tuple[FrameContext, OpenedSubmap] | None:
        """Go on with the solution that was begun. Returns the frame in which a submap begins by it, the last one."""
        start = self._inertial_start
        found = None if start is None else start.go_on()
        if start is None or found is None:
            return None
        return found.frame, self._open_in_metres(found, start)

    def _open_in_metres(self, found: InertialMap, start: InertialStart) -> OpenedSubmap:
        camera, solution, ctx = self._camera, found.solution, self._corrected(found.frame, found.lens)
        gravity_b = solution.T_w_b[:3, :3].T @ solution.gravity
        if not camera.submaps.any:
            camera.set_first_gravity(gravity_b)
        elif camera.had_metres:
            camera.leave_submap()
        else:  # nothing tells how it lies to maps whose units of length are their own
            camera.begin_upright(gravity_b)
            self._corrections.leave_world()
        camera.begin_metres()
        submap = camera.open_submap()
        camera.pose.reset_motion()
        # Corners of several images would take a second of a small budget at once.
        if ctx.config.keyframe.earlier and not self._governor.on:
            gap_ns = self._channel.keyframe_gap_ns()
            self._keyframes.share_earlier(ctx, earlier_views(found, self._map.camera, ctx.config, gap_ns))
        keyframe = self._keyframes.make(ctx, None, found.points.points, camera.pose.T_m_c, Extra.SUBMAP)
        found.points.set_sigma(self._map, keyframe)
        self._channel.put(SubmapScale(submap, 1.0))
        state = InertialStartState(
            solution.T_w_b,
            solution.velocity,
            solution.bias,
            solution.gravity,
            found.cov,
            found.accel_noise,
            solution.offset,
        )
        camera.motion.begin_metric_map(ctx.t_ns, state)
        start.clear()
        text = f"mono: metric within {100.0 * found.scale_sigma:.1f} %, from {found.duration_s:.1f} s of images and IMU"
        off_px = lens_correction.rms_px(found.lens, self._rectifier.camera)
        return OpenedSubmap(True, ["submap: opened", text, f"camera: pixels corrected by {off_px:.2f} px rms"])

    def _corrected(self, ctx: FrameContext, lens: F64) -> FrameContext:
        """Read this frame and all later ones through the corrected lens (8,)."""
        camera = self._rectifier.camera
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        self._rectifier.correct_left(lambda uv: lens_correction.moved((uv - centre) / focal, lens) * focal + centre)
        return replace(ctx, images=ctx.images.rectified_by(self._rectifier))

    def _open_from_two_views(self, ctx: FrameContext, start: TwoViewStart) -> OpenedSubmap | None:
        """Begin a monocular submap: its first keyframe is an earlier frame, the second one this frame.

        It is not joined to older ones, since their scales differ.
        """
        camera = self._camera
        if start.at_first_view and not camera.submaps.any:
            camera.set_first_pose(ctx.imu)  # the camera moves from here on
        two_views = start.add(ctx)
        if two_views is None:
            if not camera.submaps.any:
                self._warnings += self._views_watch.note(ctx.t_ns, Fault.PARALLAX)
            return None
        unit, told_by = told_unit(camera, ctx, two_views), "convention"
        if unit is not None:
            two_views = two_views.scaled(unit.metres)
            told_by = f"the motion that a sensor tells, within {100.0 * unit.sigma:.0f} %"
        since, T_k_a = camera.reference.keyframe, camera.reference.T_k_c @ se3.inverse(two_views.T_a_b)
        is_tied = unit is not None and not camera.pose.is_guess
        sigma_m, sigma_rad = camera.covariance.dead_reckoning_sigma
        if camera.submaps.any:
            camera.leave_submap()
        events = ["submap: opened", f"mono: scale by {told_by}, median depth {two_views.median_depth_m:.3g} m"]
        if unit is None and camera.had_metres:
            events.append(_NO_METRES)
        camera.motion.begin_unscaled_map(None if unit is None else unit.sigma)
        submap = camera.open_submap(metric=False)
        if is_tied:  # else the base does not place it in a map in metres
            self._loss_tie.share(submap, since, T_k_a, sigma_m, sigma_rad)
        camera.pose.reset_motion()
        # The second view stays where the camera was predicted, which places the first one.
        T_m_a = camera.pose.T_m_c @ se3.inverse(two_views.T_a_b)
        before = replace(ctx, images=two_views.images, t_ns=two_views.t_ns)
        keyframe = self._keyframes.make(before, None, two_views.points, T_m_a, Extra.SUBMAP)
        camera.reference.set_camera(camera.pose.T_m_c)
        two_views.set_sigma(self._map, keyframe, ctx.config.align.sigma_px)
        track = self._tracker.track(ctx, camera.pose.T_c_m)
        if track.inliers < ctx.config.pose.min_inliers:
            return OpenedSubmap(False, events)
        camera.set_measured(track, 0.0, repeated=ctx.repeated)
        start.note_depths(track.depth_m[track.inlier])
        self._depth.update_landmarks(ctx, track)
        dt_s = (ctx.t_ns - two_views.t_ns) * 1e-9
        velocity = (camera.pose.T_m_c[:3, 3] - T_m_a[:3, 3]) / dt_s if dt_s > 0.0 else np.zeros(3)
        camera.pose.set_motion(se3.exp(se3.log(two_views.T_a_b) / two_views.frames), velocity)
        self._keyframes.add(ctx, track)
        return OpenedSubmap(True, events)

    def join_older(self, ctx: FrameContext, track: Track) -> list[str]:
        """Search the older submaps beside a new one; if one is found, make a keyframe in both and continue in the old.

        Returns events.
        """
        self._loss_tie.update(ctx.t_ns)
        found = self._relocaliser.find_older_submap(ctx, self._camera.pose.T_m_c)
        if found is None:
            return []
        self._map.note_tracking(found.track.rows, found.track.inlier, ctx.number)
        if not self._camera.reference.is_of(ctx.number):
            self._keyframes.add(ctx, track)
        self._camera.return_to(found, ctx.number)
        self._camera.motion.restart(ctx.t_ns)
        self._keyframes.add(ctx, found.track)
        return ["submap: joined to an older one"]

    def restart_in_metres(self, ctx: FrameContext, track: Track) -> list[str]:
        """Continue a monocular map in a new submap in metres, once IMU or odometer give its scale. Returns events."""
        limits, camera = ctx.config.two_view_start, self._camera
        if ctx.number != self._tracked_number + 1:  # images did not lead in the frame before
            self._tracked_since_ns = ctx.t_ns
        self._tracked_number = ctx.number
        if self._two_view_start is None or ctx.number % limits.scale_every or not camera.submaps.room:
            return []
        correction = camera.motion.scale_correction()
        if correction is not None and (ctx.t_ns - self._tracked_since_ns) * 1e-9 < _SETTLED_S:
            return []
        unit_m = camera.motion.metres_per_unit(_SCALE_SIGMA) if correction is None else correction[0]
        if unit_m is None:
            return []
        metric = metric_points(ctx, track, self._map, unit_m)
        if len(metric.sigma_rho) < ctx.config.local_map.first_points:
            return []
        self._restart(ctx, unit_m, metric)
        if correction is None:
            return [f"mono: metric, one unit was {unit_m:.3g} m", "submap: opened"]
        return [f"mono: scale corrected by {unit_m:.4f}, within {100.0 * correction[1]:.1f} %", "submap: opened"]

    def _restart(self, ctx: FrameContext, unit_m: float, metric: MetricPoints) -> F64:
        """Begin a submap in metres here. Returns T_new_old (4,4)."""
        camera = self._camera
        old, own_unit = camera.submaps.active, not camera.motion.in_metres
        if not (own_unit or camera.motion.metric):  # lengths so far are off by what is told now
            camera.covariance.set_scale_sigma(float(np.hypot(unit_m - 1.0, _SCALE_SIGMA)))
        self._channel.put(SubmapScale(old, unit_m))
        T_new_old = self._begin_at_track(ctx, unit_m, metric, tells_scale=True)
        if own_unit:
            self._corrections.continue_in_metres(camera.submaps.active, old, unit_m)
        camera.motion.set_scale(ctx.t_ns, unit_m, T_new_old)
        if self._two_view_start is not None:
            self._two_view_start.rescale(unit_m)
        return T_new_old

    def restart_by_imu(self, ctx: FrameContext, track: Track) -> list[str]:
        """Continue a monocular map in a new submap in metres where the samples of its IMU begin late, or come back.

        The window that tells the scale before there is a map is solved beside this one. Returns events.
        """
        start, camera = self._inertial_start, self._camera
        inertial = camera.motion.tracker
        if start is None or inertial is None:
            return []
        if camera.motion.has_scale_by_imu or not start.add_samples(ctx):
            self._forget_window(start)
            return []
        if not self._may_solve_beside_map(start):
            return []
        found = start.add_beside_map(ctx, inertial.known)
        if start.keyframe_t_ns == ctx.t_ns:
            self._path.add(ctx.t_ns, camera.reference.keyframe, camera.reference.T_k_c)
        if start.contradicted and not camera.motion.running:
            self._ignore_imu(start)
        if found is None:
            return []
        events = self._continue_by_window(ctx, track, found)
        if events:
            self._forget_window(start)
        return events

    def _may_solve_beside_map(self, start: InertialStart) -> bool:
        return not start.contradicted and self._camera.submaps.room and self._governor.may_do_part()

    def _continue_by_window(self, ctx: FrameContext, track: Track, found: InertialMap) -> list[str]:
        """Continue in metres by a window of some frames ago; nothing while that does not tell the map's unit."""
        camera, solution = self._camera, found.solution
        unit = self._path.unit(tuple(k.t_ns for k in found.keyframes), solution.state, self._map.camera.T_b_c)
        sigma = np.inf if unit is None else float(np.hypot(unit.sigma, found.scale_sigma))
        if unit is None or sigma > _SCALE_SIGMA or track.inliers < ctx.config.local_map.first_points:
            return []
        ctx, own_unit = self._corrected(ctx, found.lens), not camera.motion.metric
        T_new_old = self._restart(ctx, unit.metres, metric_points(ctx, track, self._map, unit.metres, found.lens))
        gravity = T_new_old[:3, :3] @ unit.R_m_w @ solution.gravity
        state = InertialStartState(
            camera.T_m_b, camera.pose.velocity, solution.bias, gravity, None, found.accel_noise, solution.offset
        )  # fmt: skip
        camera.motion.begin_metric_map(ctx.t_ns, state)
        camera.gravity.settle(ctx.t_ns)
        text = f"mono: metric within {100.0 * sigma:.1f} %, from {found.duration_s:.1f} s of images and IMU"
        was = f"one unit was {unit.metres:.3g} m" if own_unit else f"scale corrected by {unit.metres:.4f}"
        return [f"{text}, {was}", "submap: opened"]

    def _forget_window(self, start: InertialStart) -> None:
        """Lengths are metres, or nothing tells them."""
        self._path.clear()
        start.clear()

    def continue_full(self, ctx: FrameContext, track: Track) -> list[str]:
        """Continue in a new submap where the ids of keyframes in the active one are used up. Returns events.

        The base merges the two by keyframes of this frame in both, or by the inertial steps of a monocular map.
        """
        camera = self._camera
        if not (camera.reference.is_full(camera.submaps.active) and camera.submaps.room):
            return []
        monocular, made = self._two_view_start is not None, camera.reference.is_of(ctx.number)
        points = metric_points(ctx, track, self._map, 1.0)
        if len(points.sigma_rho) < ctx.config.local_map.first_points or (monocular and made):
            return []  # no inertial steps lead from a keyframe of this frame
        if not (monocular or made):
            self._keyframes.add(ctx, track)
        T_new_old = self._begin_at_track(ctx, 1.0, points, tells_scale=monocular and camera.motion.metric)
        camera.motion.continue_map(ctx.t_ns, T_new_old)
        return ["submap: full", "submap: opened"]

    def _begin_at_track(self, ctx: FrameContext, unit_m: float, points: MetricPoints, *, tells_scale: bool) -> F64:
        """Begin a submap whose first landmarks are those that are tracked, and tie it to the one before.

        unit_m: metres in one unit of the old submap. Returns T_new_old (4,4).
        """
        camera = self._camera
        since, T_k_c = camera.reference.keyframe, camera.reference.T_k_c.copy()
        T_new_old = camera.continue_in_metres(unit_m)
        if tells_scale:
            camera.begin_metres()
        if unit_m != 1.0:
            self._map.drop_submap(camera.submaps.active)
        submap = camera.open_submap(metric=tells_scale or self._two_view_start is None)
        keyframe = self._keyframes.make(ctx, None, points.points, camera.pose.T_m_c, Extra.SUBMAP)
        points.set_sigma(self._map, keyframe)
        if tells_scale:
            self._channel.put(SubmapScale(submap, 1.0))
        if since != NO_KEYFRAME:
            self._channel.put(SubmapTie(submap, since, T_k_c, TRACKED_M, TRACKED_RAD))
        return T_new_old

"""The onboard half: one step takes a frame, inertial samples and packets, and gives a pose and packets. Sans-IO."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.camera import joined
from kiteline_agent.certainty import Certainty
from kiteline_agent.config import AgentConfig
from kiteline_agent.cost_model import Work
from kiteline_agent.depth_from_motion import DepthFromMotion
from kiteline_agent.from_base import FromBase
from kiteline_agent.frozen import FrozenEye
from kiteline_agent.glimpse import Glimpse
from kiteline_agent.governor import FULL, Extra, Governor, governed
from kiteline_agent.inertia import Inertia
from kiteline_agent.keyframe_maker import KeyframeMaker
from kiteline_agent.levelling import Levelling
from kiteline_agent.local_map import LocalMap
from kiteline_agent.metric_start import Reborn, reborn
from kiteline_agent.mono_start import MonoStart, Opening
from kiteline_agent.pose_state import PoseState
from kiteline_agent.recovery import Recovered, Recovery
from kiteline_agent.reference import Reference
from kiteline_agent.right_eye import RightEye, rectified
from kiteline_agent.step import Estimate, Identity, StepInput, StepOutput
from kiteline_agent.submaps import Submaps
from kiteline_agent.tracker import Track, Tracker, View
from kiteline_agent.window import Window, corners_of, with_depths
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import Camera, Live, Record, Tile
from kiteline_core import se3
from kiteline_core.cameras import CameraRig, Rectifier
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration
from kiteline_core.ids import (
    NO_KEYFRAME,
    SubmapId,
)
from kiteline_core.place_index import Vocabulary

F64 = NDArray[np.float64]


class Agent:
    """Tracks a camera against its own local map, shares keyframes, and takes over what the base makes of them."""

    def __init__(
        self,
        rig: CameraRig,
        imu: ImuCalibration | None,
        config: AgentConfig,
        identity: Identity,
        channel: RecordChannel,
        words: Vocabulary | None = None,
    ) -> None:
        """words: those by which places are recognised; without them only the reference keyframe is found again."""
        self._config = config
        self._identity = identity
        self._channel = channel
        self._rectifier = Rectifier(rig)
        self._camera = self._rectifier.camera
        self._T_c_b = se3.inverse(self._camera.T_b_c)
        one_eye = rig.right is None and not rig.has_depth
        self._pose = PoseState()
        self._inertia = Inertia(self._camera, imu, config.inertial, self._pose, metric=not one_eye)
        self._bridged = False  # the last pose is the IMU's alone
        self._levelling = Levelling(
            self._camera, self._inertia.tracker, config.inertial.askew_rad, config.inertial.level_patience_s
        )
        self.map = LocalMap(self._camera, config.local_map, config.depth_filter)
        self.work = Work()  # of the last step
        self._tracker = Tracker(self.map, config, self.work)
        self._maker = KeyframeMaker(self.map, self._camera, config, channel, self.work)
        self._reference = Reference(self.map, self._camera, self._maker)
        self._submaps = Submaps(identity, self.map, self._pose, self._reference, self._maker)
        self._certainty = Certainty(
            self.map, self._camera.T_b_c, config.certainty, has_body=rig.has_body, has_depth=not one_eye
        )
        self._full_config = config  # before the governor saves on it
        self._governor = Governor(config.governor, inertial=imu is not None)
        self._effort = FULL
        self._held_imu: list[ImuBatch] = []  # of frames that were skipped
        self._motion_depth = DepthFromMotion(self.map, config, self.work)
        self._mono = MonoStart(self._camera, config) if one_eye else None
        self._glimpse = Glimpse(self._camera)
        self.window = Window(self._camera, config.window, config.matching, config.ransac, words)
        self._base = FromBase(self.map, self.window, config.smoothing)
        self._recovery = Recovery(self.map, self._tracker, config, words, self.window, self._believes)
        self._frozen = FrozenEye(self._camera)
        self._events: list[str] = []
        self._frame_number = 0
        self._last_t_ns: int | None = None
        self._failures = 0  # tries since the old map was lost that had texture in view
        self._lost = False  # the last frame had no pose
        self._predicted: F64 = np.eye(4)  # T_m_c of this frame
        channel.put(Camera(identity.agent, self._camera))

    # one step

    def step(self, step_input: StepInput, now_ns: int) -> StepOutput:
        """Take in what arrived, track the frame if there is one, say what is to be sent. Never waits."""
        self._events = []
        self._take_corrections(self._channel.receive(step_input.packets, now_ns))
        estimate = None
        self.work.clear()
        self.work.steps = 1
        if step_input.frame is not None and self._governed(step_input.frame.t_ns, step_input):
            imu, self._held_imu = joined(self._held_imu), []
            self.work.inertial_samples = 0 if imu is None else len(imu.t_ns)
            estimate = self._process(step_input.frame, imu)
        return StepOutput(estimate, tuple(self._channel.poll(now_ns)), tuple(self._events))

    def _process(self, frame: Frame, imu: ImuBatch | None) -> Estimate:
        # 1. Rectify and build pyramids.
        view = self._view(frame)
        # 2. Predict from the IMU or from the last motion.
        dt_s = 0.0 if self._last_t_ns is None else (frame.t_ns - self._last_t_ns) * 1e-9
        predicted = self._predicted = self._inertia.predict(frame.t_ns, imu, dt_s)
        self._certainty.guide(self._inertia.running)
        # 3. Track against the local map, or begin a map.
        self._frame_number += 1
        track = None
        frozen = self._submaps.any and self._frozen.repeats(frame.left, self._pose.T_o_m @ predicted)
        if self._submaps.any and not frozen:
            track = self._tracker.track(view, se3.inverse(predicted), self._frame_number)
            track = self._second_look(view, track)
        enough = track is not None and track.inliers >= self._config.pose.min_inliers
        if track is not None and enough and self._believes(track.T_c_m, self.submap):
            track = self._fuse(track, frame.t_ns)
            if self._lost:
                self._land(predicted, track)
            self._accept(track, dt_s)
            self._look_up(frame.t_ns)
            # 4. Look for the depth of what was born without one.
            self._motion_depth.update(view, track)
            # 5. Make a keyframe where the policy asks for one.
            self._keyframe_if_due(view, track, frame.t_ns)
            self._join_if_found(view, track, frame.t_ns)
            self._find_scale(view, track, frame.t_ns)
            tracked = True
        else:
            # 5. Lost: the IMU carries on for a while; search the old map; with texture in view and two failed tries,
            # open a new submap.
            self._bridged = self._coast(predicted, frame.t_ns, dt_s)
            track = None if frozen else self._recover(view, frame.t_ns)
            found = track is not None or (not frozen and self._begin_submap(view, frame.t_ns, imu))
            if found:
                self._bridged = False
                self._inertia.restart(frame.t_ns)
            tracked = found or self._bridged
        inliers = track.inliers if track is not None else 0
        self._lost = not tracked or self._bridged
        if not self._lost:
            self._glimpse.remember(view.left, self._pose.T_c_m)
        self._last_t_ns = frame.t_ns
        return self._estimate(frame.t_ns, inliers, tracked=tracked)

    def _governed(self, t_ns: int, step_input: StepInput) -> bool:
        """Whether the frame is tracked, at the effort on which the governor decides; its samples are kept anyhow."""
        if step_input.imu is not None:
            self._held_imu.append(step_input.imu)
        decision = self._governor.frame(t_ns, step_input.cpu_ns, lost=self._failures > 0, carried=self._inertia.running)
        self._events.extend(decision.events)
        if decision.effort != self._effort:
            self._effort, points = decision.effort, self._config.align.points
            self._config = governed(self._full_config, decision.effort)
            self._tracker.configure(self._config)
            self._maker.configure(self._config)
            self.map.searched = self._config.local_map.searched
            self._reference.fewer_points(points, self._config.align.points)
        return decision.track

    def _view(self, frame: Frame) -> View:
        levels = self._config.pyramid.levels
        # Coarse images are for a track that holds: what is lost or begins needs all there is.
        first = self._config.pyramid.first if self._submaps.any and self._failures == 0 else 0
        left = rectified(frame.left, self._rectifier, 0, levels, first)
        right = None if frame.right is None else RightEye(frame.right, self._rectifier, levels, self.map.offset_px)
        depth = None if frame.depth_m is None else self._rectifier.depth(frame.depth_m)
        self.work.frames = 1
        share = 4 if first else 1
        self.work.rectified_px += frame.left.size // share if self._rectifier.bends else 0
        self.work.pyramid_px += frame.left.size * (1 if right is None or not self._config.stereo.points else 2)
        return View(left, right, depth, first if self._rectifier.bends else 0)

    def _second_look(self, view: View, track: Track) -> Track:
        """The same track, or where it missed most points the best of others that begin elsewhere."""
        if self._holds(track):
            return track
        # 1. Where the whole image seems to have gone.
        guess = self._glimpse.guess(view.left)
        if guess is not None:
            again = self._tracker.track(view, guess, self._frame_number)
            track = again if again.inliers > track.inliers else track
        # 2. Where descriptors say. Of a track that has failed altogether `_recover` takes care.
        if self._holds(track) or track.inliers < self._config.pose.min_inliers or not self._governor.may(Extra.SEARCH):
            return track
        self.work.searches += 1
        found = self._recovery.attempt(view, self._frame_number, self._reference.keyframe)
        if found is None or found.submap != self._submaps.active or found.track.inliers < track.inliers:
            return track
        return found.track

    def _holds(self, track: Track) -> bool:
        return track.inliers >= max(self._config.pose.min_inliers, self._config.pose.min_share * track.tried)

    # motion

    def _fuse(self, track: Track, t_ns: int) -> Track:
        """The track with the pose that images and IMU together give."""
        self._bridged = False
        self.work.fused = int(self._inertia.tracker is not None)
        fused = self._inertia.fuse(track, t_ns)
        if self._inertia.tracker is not None:
            self._certainty.fused(track.T_c_m, fused.T_c_m)
        self._events += self._inertia.news()
        return fused

    def _find_scale(self, view: View, track: Track, t_ns: int) -> None:
        """One eye with an IMU: once acceleration tells how long the map's unit is, begin a map in metres."""
        limits = self._config.mono_start
        if self._frame_number % limits.scale_every or not self._submaps.room:
            return
        unit_m = self._inertia.unit_m(limits.scale_sigma)
        if unit_m is None:
            return
        born = reborn(view, track, self.map, unit_m, self._config.detector.cell_px)
        if len(born.sigma_rho) >= self._config.local_map.first_points:
            self._begin_in_metres(view, t_ns, unit_m, born)

    def _land(self, guessed_T_m_c: F64, track: Track) -> None:
        """Tracked again after a loss: what the guess was off by is the map's, the odometry frame stays continuous."""
        self._pose.T_m_c = guessed_T_m_c
        self._certainty.carry(self._pose, self._T_c_b, self.submap)
        self._pose.move_map(se3.inverse(track.T_c_m))

    def _coast(self, predicted: F64, t_ns: int, dt_s: float) -> bool:
        """A frame that the images do not place. Returns whether the IMU alone still carries a pose to be trusted."""
        coasted = self._inertia.coast(predicted, t_ns)
        self._pose.T_m_c = coasted.T_m_c
        self._reference.refresh(self._pose.T_m_c)
        self._certainty.blind(dt_s, coasted.cov)
        return coasted.trusted

    def _look_up(self, t_ns: int) -> None:
        """See which way is up; where the first submap lies askew, because it began in motion, the base is told."""
        T_m_b = self._pose.T_m_c @ self._T_c_b
        level = self._levelling.look(
            t_ns, T_m_b, self._pose.T_o_m[:3, :3], self.submap, first=self._submaps.opened == 1
        )
        if level is not None:
            self._channel.put(level)
            self._base.set_upright(level)
            self._events.append(f"submap lies {np.degrees(self._levelling.askew_rad):.1f} degrees askew")

    def _accept(self, track: Track, dt_s: float) -> None:
        """Take over a measured pose and what it says of the points and of the motion."""
        self._pose.measured(se3.inverse(track.T_c_m), dt_s, repeated=self._frozen.repeated)
        self._failures = 0
        self._certainty.measured(track)
        if self._mono is not None:
            self._mono.tracked(track.depth_m[track.inlier])
        self.map.note_tracking(track.rows, track.inlier, self._frame_number)
        self.map.sharpen(
            track.T_c_m, track.rows, track.inlier, track.observed, track.sigma_px, self._config.depth_filter.inflation
        )
        self._reference.refresh(self._pose.T_m_c)

    # keyframes and submaps

    def _keyframe_if_due(self, view: View, track: Track, t_ns: int) -> None:
        wish = self._reference.asks(track, t_ns, self._frame_number, self._config, self._channel.keyframe_gap_ns())
        if wish is None:
            return
        if not self._governor.may(Extra.KEYFRAME, urgent=wish.urgent):
            self._events.append("governor: keyframe put off")
        elif not wish.waits:
            self._events.append(f"keyframe: {wish.why}")
            self._add_keyframe(view, track, t_ns)

    def _add_keyframe(self, view: View, track: Track, t_ns: int) -> None:
        self._yield_to_copies(view, track)
        self._reference.add(view, track, t_ns, self._frame_number, self._submaps.active, self._pose.T_m_c)
        self._note_keyframe(view, Extra.KEYFRAME)

    def _yield_to_copies(self, view: View, track: Track) -> None:
        """A keyframe's corners meet the base's copies: it takes over their depths, and moves a little towards where
        they say that it is. The odometry frame stays still.
        """
        if not self.window.lies_in(self.submap):
            return
        fresh = self._maker.look(view, track)
        limits = self._config.window
        met = self.window.meet(self._pose.T_c_m, self.submap, corners_of(fresh), limits.hold_radius_px)
        self.work.projected += len(self.window) * limits.points
        self._maker.begin_with(fresh if met is None else with_depths(fresh, met))
        if met is None:
            return
        goal = self.window.yields(self._pose.T_c_m, met)
        if goal is not None:
            self._move_map(se3.inverse(goal))

    def _move_map(self, T_m_c: F64) -> None:
        """The camera is at T_m_c (4,4) in the submap, and moved in no other frame."""
        before = self._pose.T_m_c
        self._pose.move_map(T_m_c)
        self._inertia.shift(se3.orthonormalise(self._pose.T_m_c @ se3.inverse(before)))
        self._reference.refresh(self._pose.T_m_c)

    def _note_keyframe(self, view: View, extra: Extra) -> None:
        """What follows every keyframe: it is booked, and its place remembered."""
        self._governor.note(extra)
        if view.right is not None and self._rectifier.bends:
            self.work.rectified_px += view.left[1].size
        self._recovery.remember(self._reference.keyframe)
        self._certainty.remember(self._reference.keyframe)

    def _begin_submap(self, view: View, t_ns: int, imu: ImuBatch | None) -> bool:
        """Open a submap when the old map was not found again. Returns whether there is a pose now."""
        first = not self._submaps.any
        if not first:
            tried = self._failures >= self._config.recovery.failures
            if not tried or not self._submaps.room or not self._governor.may(Extra.SUBMAP):
                return False
        # 1. See whether this frame can begin a map: by two views, or by what the pair gives.
        opening = None
        if self._mono is not None:
            if self._last_t_ns is None:
                self._pose.T_m_c = self._levelling.first_pose(imu)  # the camera moves from here on
            self.work.searches += 1
            opening = self._mono.step(view, t_ns)
            if opening is None:
                return False
        elif not self._maker.enough(view, self._config.local_map.first_points):
            return False
        # 2. Set the camera into it.
        if not first:
            self._certainty.carry(self._pose, self._T_c_b, self.submap)
            self._pose.enter_submap()
            if self._mono is None:  # maps of one eye differ in scale: no rigid motion joins them
                self._recovery.search_beside(self._frame_number)
        elif opening is None:
            self._pose.T_m_c = self._levelling.first_pose(imu)
        # 3. Open it.
        self._events.append("submap: opened")
        self._failures = 0
        if opening is not None:
            return self._open_from_two_views(view, t_ns, opening)
        self._certainty.begin(self._pose.T_m_c @ self._T_c_b)
        self._submaps.open_from_pair(view, t_ns, self._frame_number)
        self._note_keyframe(view, Extra.SUBMAP)
        return True

    def _open_from_two_views(self, view: View, t_ns: int, opening: Opening) -> bool:
        """The first two keyframes of one eye's map."""
        self._events.append(f"mono: scale by convention, median depth {opening.median_depth_m:.3g} m")
        self._inertia.forget_unit()
        self._certainty.begin(self._pose.T_m_c @ self._T_c_b)
        T_m_a = self._submaps.open_from_two_views(self._frame_number, opening, self._config.align.sigma_px)
        self._note_keyframe(view, Extra.SUBMAP)
        track = self._tracker.track(view, self._pose.T_c_m, self._frame_number)
        if track.inliers < self._config.pose.min_inliers:
            return False
        self._accept(track, 0.0)
        dt_s = (t_ns - opening.t_ns) * 1e-9
        velocity = (self._pose.T_m_c[:3, 3] - T_m_a[:3, 3]) / dt_s if dt_s > 0.0 else np.zeros(3)
        self._pose.go_on(se3.exp(se3.log(opening.T_a_b) / opening.frames), velocity)
        self._add_keyframe(view, track, t_ns)
        return True

    def _begin_in_metres(self, view: View, t_ns: int, unit_m: float, born: Reborn) -> None:
        """Go on in a new submap whose unit is a metre."""
        assert self._mono is not None
        self._events += [f"mono: metric, one unit was {unit_m:.3g} m", "submap: opened"]
        self._certainty.carry(self._pose, self._T_c_b, self.submap)
        T_n_m = self._submaps.open_in_metres(view, t_ns, self._frame_number, unit_m, born)
        self._certainty.begin(self._pose.T_m_c @ self._T_c_b)
        self._note_keyframe(view, Extra.SUBMAP)
        self._inertia.begin_metres(unit_m, T_n_m)
        self._mono.rescale(unit_m)

    # the old map found again

    def _recover(self, view: View, t_ns: int) -> Track | None:
        """Look for a lost frame in all that is remembered."""
        if not self._submaps.any:
            return None
        if not self._governor.may(Extra.SEARCH):
            self._events.append("governor: search put off")
            self._failures = max(self._failures, 1)
            return None
        self.work.searches += 1
        found = self._recovery.attempt(view, self._frame_number, self._reference.keyframe)
        if found is None:
            self._failures += self._recovery.textured
            return None
        self._events.append("recovered by copies" if found.lent else "recovered")
        self._return_to(found)
        self._pose.stand()
        if found.lent:  # none of its points is in the local map yet
            self._add_keyframe(view, found.track, t_ns)
        else:
            self._keyframe_if_due(view, found.track, t_ns)
        return found.track

    def _join_if_found(self, view: View, track: Track, t_ns: int) -> None:
        """Beside a young submap, look for the old ones; where one is found, a keyframe in each says how they lie."""
        found = self._recovery.beside(view, self._frame_number, self._pose.T_m_c)
        if found is None:
            return
        self._events.append("submap: joined to an older one")
        self.map.note_tracking(found.track.rows, found.track.inlier, self._frame_number)
        if not self._reference.is_of(self._frame_number):
            self._add_keyframe(view, track, t_ns)
        self._return_to(found)
        self._inertia.restart(t_ns)
        self._add_keyframe(view, found.track, t_ns)

    def _return_to(self, found: Recovered) -> None:
        self._certainty.carry(self._pose, self._T_c_b, self.submap)
        self._submaps.return_to(found, self._frame_number)
        if found.lent:
            self._certainty.met(found.keyframe, found.T_c_m, found.track.inliers)
        else:
            self._certainty.measured(found.track)
        self._failures = 0

    def _believes(self, T_c_m: F64, submap: SubmapId) -> bool:
        return self._certainty.believes(T_c_m, submap, self._predicted, self._pose, self._T_c_b, self.submap)

    @property
    def submap(self) -> SubmapId:
        """The submap in which the agent tracks (the first one before it has begun)."""
        return self._submaps.active

    @property
    def tiles(self) -> dict[tuple[int, int], Tile]:
        """The grid as the base sent it, by column and row."""
        return self._base.tiles

    @property
    def metric(self) -> bool:
        """Whether the active submap's lengths are metres; one eye alone measures in a unit of its own."""
        return self._inertia.metric

    def time_offset_report(self) -> dict[str, float] | None:
        """InertialTracker.offset_report; None without an IMU."""
        return None if self._inertia.tracker is None else self._inertia.tracker.offset_report()

    # what the base sends

    def _take_corrections(self, records: list[Record]) -> None:
        """Swap in what the base made of the map; the odometry frame stays still."""
        if not self._base.take(records, self._channel.take_removed(), self._events):
            return
        T_m_k = self._reference.T_m_k
        if T_m_k is not None:
            self._move_map(T_m_k @ self._reference.T_k_c)
            self._certainty.corrected(self._pose)

    # what is known

    def _estimate(self, t_ns: int, inliers: int, *, tracked: bool) -> Estimate:
        T_m_b = self._pose.T_m_c @ self._T_c_b
        cov_m, cov_o = self._certainty.of_poses(self._pose, T_m_b)
        quality = self._certainty.quality(cov_m if tracked else cov_o, inliers or None)
        carried = self._submaps.any and self._inertia.running
        if not tracked and (not carried or quality < self._config.certainty.flagged_below):
            quality = -1
        keyframe, T_k_c = self._reference.keyframe, self._reference.T_k_c
        if keyframe != NO_KEYFRAME:
            self._channel.put(Live(self._identity.agent, t_ns, keyframe, T_k_c, quality))
        T_w_b = self._base.in_world(self.submap, T_m_b, self._pose.T_o_m, t_ns)
        return Estimate(
            t_ns,
            tracked,
            self._bridged,
            T_m_b if tracked else None,
            self._pose.T_o_m @ T_m_b,
            keyframe,
            T_k_c.copy(),
            self.submap,
            inliers,
            quality,
            cov_m,
            cov_o,
            self._levelling.R_l_o,
            T_w_b if tracked else None,
        )

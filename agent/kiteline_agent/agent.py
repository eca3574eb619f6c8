"""The onboard half: one step takes a frame, inertial samples and packets, and gives a pose and packets. Sans-IO."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.governor import FULL, Extra, governed
from kiteline_agent.keyframes.depth_from_motion import DepthFromMotion
from kiteline_agent.relocalisation.relocaliser import Relocalisation
from kiteline_agent.runtime.frame_reader import joined
from kiteline_agent.stages import Stages
from kiteline_agent.step import Estimate, Identity, StepInput, StepOutput
from kiteline_agent.submaps.map_growth import MapGrowth
from kiteline_agent.tracking.frame_images import RightImage, rectified
from kiteline_agent.tracking.image_shift import ImageShift
from kiteline_agent.tracking.tracker import FrameImages, Track
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import CameraIntrinsics, GridTile, LivePose, Record
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraRig
from kiteline_core.ids import NO_KEYFRAME, SubmapId
from kiteline_core.places.place_index import Vocabulary

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
        self._s = s = Stages(rig, imu, config, identity, channel, words)  # shared with the growth of the map
        self.map = s.map
        self.window = s.window
        self.work = s.work  # of the last step
        self._identity = identity
        self._full_config = config  # before the governor saves on it
        self._pose = s.pose
        self._inertia = s.inertia
        self._certainty = s.certainty
        self._reference = s.reference
        self._submaps = s.submaps
        self._recovery = s.recovery
        self._governor = s.governor
        self._effort = FULL
        self._held_imu: list[ImuBatch] = []  # of frames that were skipped
        self._growth = MapGrowth(s)
        self._motion_depth = DepthFromMotion(s.map, config, s.work)
        self._glimpse = ImageShift(s.camera)
        self._bridged = False  # the last pose is that of IMU or odometer alone
        self._lost = False  # the last frame had no pose
        channel.put(CameraIntrinsics(identity.agent, s.camera))

    # one step

    def step(self, step_input: StepInput, now_ns: int) -> StepOutput:
        """Take in what arrived, track the frame if there is one, say what is to be sent. Never waits."""
        self._s.events.clear()
        self._take_corrections(self._s.channel.receive(step_input.packets, now_ns))
        self._inertia.hear(step_input.odometry)
        estimate = None
        self.work.clear()
        self.work.steps = 1
        if step_input.frame is not None and self._governed(step_input.frame.t_ns, step_input):
            imu, self._held_imu = joined(self._held_imu), []
            self.work.inertial_samples = 0 if imu is None else len(imu.t_ns)
            estimate = self._process(step_input.frame, imu)
        return StepOutput(estimate, tuple(self._s.channel.poll(now_ns)), tuple(self._s.events))

    def _process(self, frame: Frame, imu: ImuBatch | None) -> Estimate:
        # 1. Rectify and build pyramids.
        view = self._view(frame)
        # 2. Predict from the IMU, from an odometer, or from the last motion.
        dt_s = 0.0 if self._s.last_t_ns is None else (frame.t_ns - self._s.last_t_ns) * 1e-9
        predicted = self._s.predicted = self._inertia.predict(frame.t_ns, imu, dt_s)
        self._certainty.guide(self._inertia.running)
        # 3. Track against the local map, or begin a map.
        self._s.frame += 1
        track = None
        frozen = self._submaps.any and self._s.frozen.repeats(frame.left, self._pose.T_o_m @ predicted)
        if self._submaps.any and not frozen:
            track = self._s.tracker.track(view, se3.inverse(predicted), self._s.frame)
            track = self._second_look(view, track)
        enough = track is not None and track.inliers >= self._s.config.pose.min_inliers
        if track is not None and enough and self._s.believes(track.T_c_m, self.submap):
            track = self._fuse(track, frame.t_ns)
            if self._lost:
                self._land(predicted, track)
            self._growth.accept(track, dt_s)
            self._look_up(frame.t_ns)
            # 4. Look for the depth of what was born without one.
            self._motion_depth.update(view, track)
            # 5. Make a keyframe where the policy asks for one.
            self._growth.keyframe_if_due(view, track, frame.t_ns)
            self._join_if_found(view, track, frame.t_ns)
            self._growth.find_scale(view, track, frame.t_ns)
            tracked = True
        else:
            # 5. Lost: the IMU carries on for a while, and the map with it; search the old map; with texture in view and
            # two failed tries, open a new submap.
            self._bridged = self._coast(predicted, frame.t_ns, dt_s)
            goes_on = self._bridged and not frozen and self._growth.go_on(view, frame.t_ns)
            track = None if frozen or goes_on else self._recover(view, frame.t_ns)
            found = track is not None or (
                not frozen and not goes_on and self._growth.begin_submap(view, frame.t_ns, imu)
            )
            if found:
                self._bridged = False
                self._inertia.restart(frame.t_ns)
            tracked = found or self._bridged
        inliers = track.inliers if track is not None else 0
        self._lost = not tracked or self._bridged
        if not self._lost:
            self._glimpse.remember(view.left, self._pose.T_c_m)
        self._s.last_t_ns = frame.t_ns
        return self._estimate(frame.t_ns, inliers, tracked=tracked)

    def _governed(self, t_ns: int, step_input: StepInput) -> bool:
        """Whether the frame is tracked, at the effort on which the governor decides; its samples are kept anyhow."""
        if step_input.imu is not None:
            self._held_imu.append(step_input.imu)
        decision = self._governor.frame(
            t_ns, step_input.cpu_ns, lost=self._s.failures > 0, carried=self._inertia.running
        )
        self._s.events.extend(decision.events)
        if decision.effort != self._effort:
            self._effort, points = decision.effort, self._s.config.align.points
            self._s.config = governed(self._full_config, decision.effort)
            self._s.tracker.configure(self._s.config)
            self._s.maker.configure(self._s.config)
            self.map.searched = self._s.config.local_map.searched
            self._reference.fewer_points(points, self._s.config.align.points)
        return decision.track

    def _view(self, frame: Frame) -> FrameImages:
        levels = self._s.config.pyramid.levels
        # Coarse images are for a track that holds: what is lost or begins needs all there is.
        first = self._s.config.pyramid.first if self._submaps.any and self._s.failures == 0 else 0
        left = rectified(frame.left, self._s.rectifier, 0, levels, first)
        right = None if frame.right is None else RightImage(frame.right, self._s.rectifier, levels, self.map.offset_px)
        depth = None if frame.depth_m is None else self._s.rectifier.depth(frame.depth_m)
        self.work.frames = 1
        share = 4 if first else 1
        self.work.rectified_px += frame.left.size // share if self._s.rectifier.bends else 0
        self.work.pyramid_px += frame.left.size * (1 if right is None or not self._s.config.stereo.points else 2)
        return FrameImages(left, right, depth, first if self._s.rectifier.bends else 0)

    def _second_look(self, view: FrameImages, track: Track) -> Track:
        """The same track, or where it missed most points the best of others that begin elsewhere."""
        if self._holds(track):
            return track
        # 1. Where the whole image seems to have gone.
        guess = self._glimpse.guess(view.left)
        if guess is not None:
            again = self._s.tracker.track(view, guess, self._s.frame)
            track = again if again.inliers > track.inliers else track
        # 2. Where descriptors say. Of a track that has failed altogether `_recover` takes care.
        if (
            self._holds(track)
            or track.inliers < self._s.config.pose.min_inliers
            or not self._governor.may(Extra.SEARCH)
        ):
            return track
        self.work.searches += 1
        found = self._recovery.attempt(view, self._s.frame, self._reference.keyframe)
        if found is None or found.submap != self._submaps.active or found.track.inliers < track.inliers:
            return track
        return found.track

    def _holds(self, track: Track) -> bool:
        return track.inliers >= max(self._s.config.pose.min_inliers, self._s.config.pose.min_share * track.tried)

    # motion

    def _fuse(self, track: Track, t_ns: int) -> Track:
        """The track with the pose that images and IMU together give."""
        self._bridged = False
        self.work.fused = int(self._inertia.tracker is not None)
        fused = self._inertia.fuse(track, t_ns)
        if self._inertia.tracker is not None:
            self._certainty.fused(track.T_c_m, fused.T_c_m)
        self._s.events += self._inertia.news()
        return fused

    def _land(self, guessed_T_m_c: F64, track: Track) -> None:
        """Tracked again after a loss: what the guess was off by is the map's, the odometry frame stays continuous."""
        self._pose.T_m_c = guessed_T_m_c
        self._s.carry_certainty()
        self._pose.move_map(se3.inverse(track.T_c_m))

    def _coast(self, predicted: F64, t_ns: int, dt_s: float) -> bool:
        """A frame that the images do not place. Returns whether the IMU alone still carries a pose to be trusted."""
        coasted = self._inertia.coast(predicted, t_ns)
        self._pose.T_m_c = coasted.T_m_c
        self._reference.refresh(self._pose.T_m_c)
        self._certainty.blind(dt_s, coasted.cov, moves=self._pose.moves)
        return coasted.trusted

    def _look_up(self, t_ns: int) -> None:
        """See which way is up; where the first submap lies askew, because it began in motion, the base is told."""
        T_m_b = self._pose.T_m_c @ self._s.T_c_b
        level = self._s.levelling.look(
            t_ns, T_m_b, self._pose.T_o_m[:3, :3], self.submap, first=self._submaps.opened == 1
        )
        if level is not None:
            self._s.channel.put(level)
            self._s.base.set_upright(level)
            self._s.events.append(f"submap lies {np.degrees(self._s.levelling.askew_rad):.1f} degrees askew")

    # keyframes and submaps

    # the old map found again

    def _recover(self, view: FrameImages, t_ns: int) -> Track | None:
        """Look for a lost frame in all that is remembered."""
        if not self._submaps.any:
            return None
        if not self._governor.may(Extra.SEARCH):
            self._s.events.append("governor: search put off")
            self._s.failures = max(self._s.failures, 1)
            return None
        self.work.searches += 1
        found = self._recovery.attempt(view, self._s.frame, self._reference.keyframe)
        if found is None:
            self._s.failures += self._recovery.textured
            return None
        self._s.events.append("recovered by copies" if found.lent else "recovered")
        self._return_to(found)
        self._pose.stand()
        if found.lent:  # none of its points is in the local map yet
            self._growth.add_keyframe(view, found.track, t_ns)
        else:
            self._growth.keyframe_if_due(view, found.track, t_ns)
        return found.track

    def _join_if_found(self, view: FrameImages, track: Track, t_ns: int) -> None:
        """Beside a young submap, look for the old ones; where one is found, a keyframe in each says how they lie."""
        found = self._recovery.beside(view, self._s.frame, self._pose.T_m_c)
        if found is None:
            return
        self._s.events.append("submap: joined to an older one")
        self.map.note_tracking(found.track.rows, found.track.inlier, self._s.frame)
        if not self._reference.is_of(self._s.frame):
            self._growth.add_keyframe(view, track, t_ns)
        self._return_to(found)
        self._inertia.restart(t_ns)
        self._growth.add_keyframe(view, found.track, t_ns)

    def _return_to(self, found: Relocalisation) -> None:
        self._s.carry_certainty()
        self._submaps.return_to(found, self._s.frame)
        if found.lent:
            self._certainty.met(found.keyframe, found.T_c_m, found.track.inliers)
        else:
            self._certainty.measured(found.track)
        self._certainty.returned()
        self._s.failures = 0

    @property
    def submap(self) -> SubmapId:
        """The submap in which the agent tracks (the first one before it has begun)."""
        return self._submaps.active

    @property
    def tiles(self) -> dict[tuple[int, int], GridTile]:
        """The grid as the base sent it, by column and row."""
        return self._s.base.tiles

    @property
    def metric(self) -> bool:
        """Whether the active submap's lengths are metres; one eye alone measures in a unit of its own."""
        return self._inertia.metric

    def odometry_quality(self, estimate: Estimate) -> int:
        """`quality` of T_o_b, which no map corrects: what a flight controller is to be told."""
        return min(estimate.quality, self._certainty.quality(estimate.cov_o, None))

    def time_offset_report(self) -> dict[str, float] | None:
        """InertialTracker.offset_report; None without an IMU."""
        return None if self._inertia.tracker is None else self._inertia.tracker.offset_report()

    def odometer_report(self) -> dict[str, float | bool] | None:
        """Odometer.report; None without one."""
        return self._inertia.odometer.report()

    # what the base sends

    def _take_corrections(self, records: list[Record]) -> None:
        """Swap in what the base made of the map; the odometry frame stays still."""
        if not self._s.base.take(records, self._s.channel.take_removed(), self._s.events):
            return
        T_m_k = self._reference.T_m_k
        if T_m_k is not None:
            self._s.move_map(T_m_k @ self._reference.T_k_c)
            self._certainty.corrected(self._pose)

    # what is known

    def _estimate(self, t_ns: int, inliers: int, *, tracked: bool) -> Estimate:
        T_m_b = self._pose.T_m_c @ self._s.T_c_b
        cov_m, cov_o = self._certainty.of_poses(self._pose, T_m_b)
        placed = tracked and self._s.knows_place()
        quality = self._certainty.quality(cov_m if placed else cov_o, inliers or None)
        carried = self._submaps.any and self._inertia.carried
        if not tracked and (not carried or quality < self._s.config.certainty.flagged_below):
            quality = -1
        keyframe, T_k_c = self._reference.keyframe, self._reference.T_k_c
        if keyframe != NO_KEYFRAME:
            self._s.channel.put(LivePose(self._identity.agent, t_ns, keyframe, T_k_c, quality))
        T_w_b = self._s.base.in_world(self.submap, T_m_b, self._pose.T_o_m, t_ns)
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
            self._s.levelling.R_l_o,
            T_w_b if tracked else None,
        )

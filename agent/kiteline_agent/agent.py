"""The onboard half: one step takes a frame, IMU samples and packets, and returns a pose and packets. Sans-IO.

Agent._process is the algorithm of one frame; its numbered steps are those of ARCHITECTURE.md.
"""

from functools import partial
from typing import Any

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.frame_order import FrameOrder
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.governor.effort import FULL, governed
from kiteline_agent.governor.governor import Governor
from kiteline_agent.image_cells import with_cells_for
from kiteline_agent.initialisation.inertial_start import InertialStart
from kiteline_agent.initialisation.two_view_start import TwoViewStart
from kiteline_agent.keyframes.depth_from_motion import DepthFromMotion
from kiteline_agent.keyframes.keyframe_maker import KeyframeMaker
from kiteline_agent.keyframes.slant_from_motion import SlantFromMotion
from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.mapping.keyframe_stage import KeyframeStage
from kiteline_agent.mapping.loss_stage import FrameOutcome, LossStage
from kiteline_agent.mapping.pose_report import PoseReport
from kiteline_agent.mapping.right_camera import RightCamera
from kiteline_agent.mapping.submap_stage import SubmapStage
from kiteline_agent.mapping.track_stage import TrackStage
from kiteline_agent.motion.extrapolation import LEAST_PREDICTION_PERCENT, MAX_PREDICTION_S
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_agent.relocalisation.relocaliser import Relocaliser
from kiteline_agent.scans.local_grid import LOST_S, LocalGrid, Surroundings
from kiteline_agent.scans.scan_stage import ScanStage
from kiteline_agent.step import Estimate, Identity, PredictedPose, StepInput, StepOutput
from kiteline_agent.tracking.fixed_parts_stage import FixedPartsStage
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.frame_images import frame_images
from kiteline_agent.tracking.map_anchor import MapAnchor
from kiteline_agent.tracking.shutter.shutter_stage import ShutterStage
from kiteline_agent.tracking.stuck_camera import StuckCamera
from kiteline_agent.tracking.track import Track
from kiteline_agent.tracking.tracker import Tracker
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import CameraIntrinsics, GridTile, Record
from kiteline_core.arrays import F64, Bool
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, joined
from kiteline_core.geometry.cameras import CameraRig, Rectifier
from kiteline_core.ids import SubmapId
from kiteline_core.places.place_index import Vocabulary

# Forward, right, down of a vehicle that flies where its camera looks.
_T_C_F = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_OBSTACLE_TOLD_S = 1.0  # s between two lines of the log about the nearest obstacle


class Agent:
    """Tracks a camera in its own local map, shares keyframes, and takes over the base's corrections of them."""

    def __init__(
        self,
        rig: CameraRig,
        imu: ImuCalibration | None,
        config: AgentConfig,
        identity: Identity,
        channel: RecordChannel,
        vocabulary: Vocabulary | None = None,
    ) -> None:
        """vocabulary: of the place index; without it only the reference keyframe is tried in relocalisation."""
        self._channel = channel
        config = with_cells_for(config, rig.left.width, rig.left.height)
        self._full_config = self._config = config  # the latter at the governor's effort
        self._rectifier = Rectifier(rig)
        camera = self._rectifier.camera
        self._has_depth = rig.right is not None or rig.has_depth
        self.work = Work()  # operations of the last step
        self.map = LocalMap(camera, config.local_map)
        self.map_cache = MapCache(camera, config.map_cache, vocabulary)
        self._governor = Governor(config.governor)
        self._effort = FULL
        self._camera = CameraState(rig, imu, config, identity, self.map)
        tracker = Tracker(self.map, self.work)
        self._shutter = ShutterStage(
            self.map, self._rectifier, config.readout, self._camera.known_twist,
            self._camera.has_motion_sensor, config.known_rig.readout_of(camera),
        )  # fmt: skip
        self._stuck_camera = StuckCamera(camera)
        self._fixed_parts = FixedPartsStage(self.map, self._rectifier, config.fixed_parts, config.detector)
        self._relocaliser = Relocaliser(
            self.map, tracker, config, vocabulary, self.map_cache,
            partial(self._camera.is_consistent, relocalised=True), self.work,
        )  # fmt: skip
        self._track = TrackStage(self._camera, tracker, self._relocaliser, self._governor, self._rectifier)
        self.right_camera = None
        if rig.right is not None:
            right = identity.agent, self._camera, self.map, self._rectifier, config, channel, self.work
            self.right_camera = RightCamera(*right)
        self._corrections = Corrections(
            self.map, self.map_cache, config.smoothing,
            None if self.right_camera is None else self.right_camera.take_base, config.local_grid.tiles,
        )  # fmt: skip
        rows = None if self.right_camera is None else self.right_camera.rows
        maker = KeyframeMaker(self.map, channel, rows, self.work, has_depth=self._has_depth)
        self._keyframes = KeyframeStage(self._camera, maker, self._relocaliser, self._governor, channel, self.work)
        self._depth = DepthFromMotion(self.map, config, self.work)
        self._slants = SlantFromMotion(self.map, self.work)
        self._two_view_start = None if self._has_depth else TwoViewStart(camera, config, self.work)
        self._inertial_start = inertial_start = (
            None if self._has_depth or imu is None
            else InertialStart(
                camera, imu, config, self.work, self._governor.may_solve, self._camera.motion.odometer.mean_between,
                self._shutter,
            )
        )  # fmt: skip
        self._submaps = SubmapStage(
            self._camera, self.map, tracker, maker, self._keyframes, self._relocaliser, self._depth,
            self._two_view_start, inertial_start, self._governor, channel, self._rectifier, self._corrections,
        )  # fmt: skip
        self._scans = None
        if self._has_depth and config.scan.on:
            self._scans = ScanStage(
                self._camera, self._rectifier, self.map, maker, self._governor, channel, config.scan, config.ground,
                self.work, config.detector.covered_parts,
            )  # fmt: skip
        self._local_grid = LocalGrid(config.local_grid, config.ground.slab_m)
        self._loss = LossStage(
            self._camera, self._keyframes, self._submaps, self._relocaliser, self._governor,
            monocular=not self._has_depth,
        )  # fmt: skip
        self._report = PoseReport(identity.agent, self._camera, self._corrections, channel, has_depth=self._has_depth)
        self._order = FrameOrder()
        self._skipped_imu: list[ImuBatch] = []  # since the last processed frame
        self._frame_number = 0
        self._last_t_ns: int | None = None  # of the last processed frame
        self._last_track: Track | None = None  # of the last frame, if images gave its pose in the submap
        self._placed_ns: int | None = None  # of the last frame with a pose
        self._was_lost = False  # the last frame had no pose from the images
        self._obstacle_event_ns = 0  # stamp of the last event about the nearest obstacle
        channel.put(CameraIntrinsics(identity.agent, camera))
        if self.right_camera is not None:
            self.right_camera.begin_with(config.known_rig)

    def step(self, step_input: StepInput, now_ns: int) -> StepOutput:
        """Take in what arrived, track the frame if there is one, return what is to be sent. Never waits.

        A frame that is not newer than those before is left out, which an event says; there is no estimate then.
        """
        self.work.clear()
        self.work.steps = 1
        events = self._take_corrections(self._channel.receive(step_input.packets, now_ns))
        self._camera.motion.add_odometry(step_input.odometry)
        estimate = predicted = None
        imu = self._camera.motion.timed(step_input.imu)
        if imu is not None:
            self._skipped_imu.append(imu)
        frame, late = self._order.newer(step_input.frame)
        events += late
        if frame is not None:
            self._camera.motion.see(frame.t_ns)
            tracked, more = self._govern(frame, step_input)
            events += more
            if tracked:
                estimate, more = self._process_next(frame)
                events += more
            elif self._full_config.governor.cpu_percent >= LEAST_PREDICTION_PERCENT:
                predicted = self.predict(frame.t_ns)
        elif step_input.predict_ns is not None:
            predicted = self.predict(step_input.predict_ns)
        return StepOutput(estimate, tuple(self._channel.poll(now_ns)), tuple(events), predicted)

    def predict(self, t_ns: int) -> PredictedPose | None:
        """The pose at a time after the last processed frame; None before there is a map, and too long after it."""
        waits = self._inertial_start is not None and len(self._inertial_start.waiting) > 0
        return None if waits else self._report.predict(t_ns, joined(self._skipped_imu), MAX_PREDICTION_S)

    def _process_next(self, newest: Frame) -> tuple[Estimate | None, list[str]]:
        """Process the newest frame, or what waits before it. Returns the newest frame's estimate, and events."""
        start = self._inertial_start
        if start is None or not len(start.waiting):
            imu, self._skipped_imu = joined(self._skipped_imu), []
            return self._process(newest, imu)
        if start.solving:
            ctx, outcome = self._loss.continue_start()
            if ctx is not None:
                self._finish(ctx, outcome)
            return None, outcome.events
        frame, imu = start.waiting.next_to_track() if self._camera.submaps.any else start.waiting.next()
        estimate, events = self._process(frame, imu)
        return estimate if frame is newest else None, events

    def _process(self, frame: Frame, imu: ImuBatch | None) -> tuple[Estimate, list[str]]:
        """The algorithm of one frame. Returns the estimate and events."""
        self.work.inertial_samples = 0 if imu is None else len(imu.t_ns)
        camera, config, has_map = self._camera, self._config, self._camera.submaps.any
        # 1. Build the images' pyramids.
        first = config.pyramid.first if has_map and self._loss.failed_searches == 0 else 0
        images = frame_images(frame, self._rectifier, config.pyramid, first, self.map.offset_px)
        self.work.frames = 1
        self.work.pyramid_px += frame.left.size * (2 if frame.right is not None and config.stereo.points else 1)
        # 2. Predict the pose: from the IMU, else an odometer, else the last motion.
        dt_s = 0.0 if self._last_t_ns is None else (frame.t_ns - self._last_t_ns) * 1e-9
        T_m_c = camera.predict(frame.t_ns, dt_s, imu)
        stuck = has_map and self._stuck_camera.update(frame.left, camera.pose.T_o_m @ T_m_c)
        self._frame_number += 1
        ctx = FrameContext(
            self._frame_number, frame.t_ns, dt_s, imu, images, T_m_c, config=config,
            repeated=self._stuck_camera.repeated, shutter=self._shutter.motion(frame.t_ns, dt_s),
        )  # fmt: skip
        # 3. Track the landmarks of the local map.
        submap, was_lost = self.submap, self._was_lost
        track = self._track.track(ctx, was_lost=was_lost) if has_map and not stuck else None
        if track is None:
            # 4. Not tracked: dead reckoning, relocalisation, or a new submap.
            outcome = self._loss.handle(ctx, stuck=stuck, was_lost=was_lost)
            self._forget_scans(ctx, outcome)
            self._fixed_parts.interrupt()
        else:
            # 5. Fuse the pose with IMU and odometer.
            self.work.fused = int(camera.motion.tracker is not None)
            by_images = track
            track, events = camera.fuse(ctx, track)
            if was_lost:
                camera.resume_after_loss(ctx, track)
            camera.set_measured(track, dt_s, repeated=ctx.repeated)
            self._loss.end()
            events += self._align_gravity(ctx)
            # 6. Measure a rolling shutter; update depths and slants of landmarks, and search those without a depth.
            events += self._shutter.measure(ctx, by_images, self.submap, camera.pose.T_o_m)
            if self._two_view_start is not None:
                self._two_view_start.note_depths(track.depth_m[track.inlier])
            # By images: what a fused pose differs by is in all pixels alike, and would move all depths together.
            self._depth.update_landmarks(ctx, by_images)
            self._slants.update(ctx, by_images)
            self._depth.search_seeds(ctx, track)
            if self.right_camera is not None and self._effort.first == 0:  # half an image hardly tells the offset
                T_o_m = camera.pose.T_o_m
                moved, said = self.right_camera.add(ctx.t_ns, track)
                events += said
                if moved:
                    self._corrections.move_on_board(self.submap, T_o_m)
            events += self._leave_out_fixed(ctx, by_images)
            # 7. Make a keyframe if the policy needs one.
            events += self._keyframes.add_if_needed(ctx, track)
            events += self._scan(ctx)
            # 8. Join an older submap that is recognised, or continue in a new one.
            events += self._submaps.join_older(ctx, track)
            continued = (
                self._submaps.continue_full(ctx, track)
                or self._submaps.restart_in_metres(ctx, track)
                or self._submaps.restart_by_imu(ctx, track)
            )
            if continued:
                self._corrections.note_continued(self.submap)
                if self._camera.motion.running:  # a window has told the vertical of this map in metres
                    continued += self._align_gravity(ctx)
            events += continued + self._submaps.take_warnings()
            outcome = FrameOutcome(True, False, track.inliers, events)
        if self.right_camera is not None:
            outcome.events.extend(self.right_camera.share_rows())
        self.work.rectified_px += images.rectified_px
        # 9. Report the pose.
        self._last_track = None if not outcome.tracked or outcome.bridged or self.submap != submap else track
        return self._finish(ctx, outcome), outcome.events

    # stages of a frame

    def _finish(self, ctx: FrameContext, outcome: FrameOutcome) -> Estimate:
        """Note how a frame ended, and report its pose."""
        self._shutter.end_frame(ctx.t_ns)
        self._was_lost = not outcome.tracked or outcome.bridged
        if not self._was_lost:
            self._track.remember(ctx)
        self._last_t_ns = ctx.t_ns
        self._placed_ns = ctx.t_ns if outcome.tracked else self._placed_ns
        return self._report.report(ctx, outcome)

    def _align_gravity(self, ctx: FrameContext) -> list[str]:
        """Tell the base how the first submap is tilted, once that is known. Returns events."""
        alignment = self._camera.align_gravity(ctx.t_ns)
        if alignment is None:
            return []
        self._channel.put(self._camera.first_aligned(alignment))
        self._corrections.set_upright(alignment)
        return [f"submap tilted by {np.degrees(self._camera.gravity.tilt_rad):.1f} degrees"]

    def _leave_out_fixed(self, ctx: FrameContext, track: Track) -> list[str]:
        """Leave out what stands still in the image while the camera turns. Returns events."""
        pose = self._camera.pose
        if self._fixed_parts.step(ctx, track, pose.T_o_m @ pose.T_m_c):
            self._full_config, self._config = map(self._fixed_parts.applied, (self._full_config, self._config))
            if self._scans is not None:
                self._scans.cover(*self._fixed_parts.for_scans())
        return self._fixed_parts.take_events(ctx.t_ns)

    def _scan(self, ctx: FrameContext) -> list[str]:
        """Continue a scan of ground and obstacles; draw a finished one into the local grid. Returns events."""
        pose = self._camera.pose
        T_o_c = pose.T_o_m @ pose.T_m_c
        cov_px = None if self.right_camera is None else self.right_camera.disparity_cov
        error = None if self._scans is None else self._scans.range_error(cov_px)
        self._local_grid.follow(T_o_c, error)
        scanned = None if self._scans is None else self._scans.step(ctx)
        if scanned is None or error is None:
            return []
        self._local_grid.add(scanned, error)
        if ctx.t_ns - self._obstacle_event_ns < _OBSTACLE_TOLD_S * 1e9:
            return []
        self._obstacle_event_ns = ctx.t_ns
        around = self._local_grid.around(T_o_c @ _T_C_F, None, {}, self._full_config.ground.bands_m)
        return [] if around is None else [around.line]

    def _forget_scans(self, ctx: FrameContext, outcome: FrameOutcome) -> None:
        """Forget the obstacles of scans once the motion of the vehicle has been unknown for too long."""
        lost_ns = 0 if outcome.bridged or self._placed_ns is None else ctx.t_ns - self._placed_ns
        if lost_ns > LOST_S * 1e9:
            self._local_grid.forget()
            if self._scans is not None:
                self._scans.forget()

    def _govern(self, frame: Frame, step_input: StepInput) -> tuple[bool, list[str]]:
        """Set the effort that the governor chooses. Returns whether to process a frame, and events.

        Under a budget, frames wait for the start of a monocular map.
        """
        t_ns, start = frame.t_ns, self._inertial_start
        camera, motion = self._camera, self._camera.motion
        windows = motion.tracker is not None and self._submaps.start_choice.awaits_window(t_ns)
        starting = windows and not camera.submaps.any
        if start is not None and self._governor.on and (starting or len(start.waiting)):
            start.waiting.add(frame, joined(self._skipped_imu))
            self._skipped_imu = []
            if starting:
                return self._governor.start_frame(t_ns, step_input.cpu_ns, solving=start.solving, idle=start.idle), []
        lost, carried = self._loss.failed_searches > 0, motion.running
        decision = self._governor.frame(t_ns, step_input.cpu_ns, lost=lost, carried=carried)
        if decision.effort != self._effort:
            self._effort, before = decision.effort, self._config
            self._config = governed(self._full_config, decision.effort)
            self.map.searched = self._config.local_map.searched
            self._camera.reference.scale_inliers(before.align.points, self._config.align.points)
        return decision.track, list(decision.events)

    def _take_corrections(self, records: list[Record]) -> list[str]:
        """Apply the records of the base; the odometry frame does not move. Returns events."""
        last, anchor = self._last_track, None
        self.map.in_own_unit = not self._camera.motion.in_metres
        if records and last is not None:
            anchor = MapAnchor(self.map, last, self._config, inertial=self._camera.motion.running)
        moved, events = self._corrections.take(records, self._channel.take_removed(), anchor)
        if moved:
            self._camera.follow_corrections(None if anchor is None else anchor.motion())
        self.work.posed_points += 0 if anchor is None else anchor.posed_points
        return events

    # what is known

    @property
    def submap(self) -> SubmapId:
        """The submap in which the camera is tracked; the first one before it is opened."""
        return self._camera.submaps.active

    @property
    def tiles(self) -> dict[tuple[int, int], GridTile]:
        """Tiles of the base's grid, by column and row."""
        return self._corrections.tiles

    def surroundings(self, pose: Estimate | PredictedPose, T_b_f: F64) -> Surroundings | None:
        """Obstacles around the vehicle, by its own scans and the base's grid; None if nothing is known.

        pose: of the last frame, or predicted since. T_b_f: (4,4) vehicle (forward, right, down) in the body.
        """
        T_w_b, bands_m = self._report.in_base_map(pose.T_o_b), self._full_config.ground.bands_m
        T_w_f = None if T_w_b is None else T_w_b @ T_b_f
        return self._local_grid.around(pose.T_o_b @ T_b_f, T_w_f, self.tiles, bands_m)

    @property
    def left_out(self) -> int:
        """Frames that were left out, as they were not newer than those before."""
        return self._order.left_out

    @property
    def fixed_cells(self) -> Bool:
        """Cells (rows, columns) of the left image that are left out, since they show what moves with the camera."""
        return self._fixed_parts.cells

    @property
    def metric(self) -> bool:
        """True if lengths in the active submap are metres; a monocular camera alone measures in a unit of its own."""
        return self._camera.motion.metric

    @property
    def in_metres(self) -> bool:
        """True if poses are in metres: also where a sensor told a new map's unit roughly, as their covariances say."""
        return self._camera.motion.in_metres

    def odometry_quality(self, estimate: Estimate) -> int:
        """`quality` of T_o_b, which no map corrects: for a flight controller."""
        return self._report.odometry_quality(estimate)

    @property
    def rig_is_of_another(self) -> bool:
        """True if what earlier flights found of the rig was found with another calibration."""
        known = self._full_config.known_rig
        return bool(known.camera) and not known.is_of(self.map.camera)

    def known_rig(self) -> KnownRigConfig | None:
        """What is known of cameras and IMU, for the next flight; None before anything was measured."""
        right = None if self.right_camera is None else self.right_camera.known()
        imu, readout_s = self._camera.motion.known_imu(), self._shutter.known_s()
        return self._full_config.known_rig.updated(self.map.camera, right, imu, readout_s)

    def motion_reports(self) -> dict[str, Any]:
        """What was found of time offset, IMU, odometer and shutter (None: nothing), and of parts of the image."""
        found = {"readout": self._shutter.report(), "fixed_parts": list(self._fixed_parts.named)}
        return {**self._camera.motion.reports(), **found}

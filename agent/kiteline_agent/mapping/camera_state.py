"""Where the camera is: pose, motion, covariance, reference keyframe and submap, which change together."""

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.covariance.pose_covariance import PoseCovariance
from kiteline_agent.inertial.gravity_alignment import GravityAligner, level_rotation, upright_about
from kiteline_agent.keyframes.reference import ReferenceKeyframe
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.submaps import Submaps
from kiteline_agent.motion.motion_model import MotionModel
from kiteline_agent.relocalisation.relocaliser import Relocalisation
from kiteline_agent.step import Identity
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.map_anchor import MapMotion
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_agent.tracking.track import Track
from kiteline_codec.schema import GravityAlignment
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraRig
from kiteline_core.ids import SubmapId


class CameraState:
    """Owner of all that is known of the camera's pose. Each method is one event of a flight.

    T_c_b: (4,4) body in the camera.
    """

    def __init__(
        self, rig: CameraRig, imu: ImuCalibration | None, config: AgentConfig, identity: Identity, local_map: LocalMap
    ) -> None:
        camera = local_map.camera
        has_depth = rig.right is not None or rig.has_depth
        self._map = local_map
        self.T_c_b = se3.inverse(camera.T_b_c)
        self.pose = PoseState()
        self.motion = MotionModel(camera, imu, config.inertial, config.odometer, self.pose, metric=has_depth)
        if self.motion.tracker is not None and config.known_rig.knows_imu_of(camera):
            self.motion.tracker.begin_with(config.known_rig.imu)
        self.covariance = PoseCovariance(
            local_map, camera.T_b_c, config.covariance, has_body=rig.has_body, has_depth=has_depth
        )  # fmt: skip
        self.gravity = GravityAligner(camera, self.motion.tracker)
        self.reference = ReferenceKeyframe(local_map)
        self.submaps = Submaps(identity)
        self._had_metres = has_depth
        self._own_units: dict[SubmapId, float | None] = {}  # `motion.rough_unit` of submaps that are not in metres
        self._T_o_first: F64 | None = None  # the first submap where images led from it into the next one

    @property
    def T_m_b(self) -> F64:
        """(4,4) body in the active submap."""
        return self.pose.T_m_c @ self.T_c_b

    @property
    def knows_motion(self) -> bool:
        """True if a sensor or earlier frames tell how the camera moves."""
        return self.motion.measures_motion or self.pose.moves

    def has_motion_sensor(self) -> bool:
        """True if an IMU or an odometer helps to tell how the camera moves."""
        return self.motion.tracker is not None or self.motion.measures_motion

    def known_twist(self, t_ns: int, dt_s: float) -> F64 | None:
        """Predicted twist (6,) [m/s, rad/s] of the camera in its own axes; None while nothing tells how it moves."""
        return self.motion.camera_twist(t_ns, dt_s) if self.knows_motion else None

    # frames

    def predict(self, t_ns: int, dt_s: float, imu: ImuBatch | None) -> F64:
        """T_m_c (4,4) of the next frame: from the IMU, else an odometer, else the last motion."""
        predicted = self.motion.predict(t_ns, imu, dt_s)
        self.covariance.set_imu_motion(measured=self.motion.running)
        return predicted

    def is_consistent(self, ctx: FrameContext, T_c_m: F64, submap: SubmapId, *, relocalised: bool) -> bool:
        """True if the camera can be at T_c_m (4,4) in a submap, by the motion since it was last measured there."""
        return self.covariance.is_consistent(
            T_c_m, submap, ctx.T_m_c, self.pose, self.T_c_b, self.submaps.active, relocalised=relocalised
        )

    def fuse(self, ctx: FrameContext, track: Track) -> tuple[Track, list[str]]:
        """The track with the pose that images, IMU and odometer give together, and events."""
        fused = self.motion.fuse(track, ctx.t_ns)
        if self.motion.has_false_vertical:
            self.gravity.forget()
        elif self.motion.has_turned_imu:
            self.gravity.renew()
        if self.motion.tracker is not None:
            self.covariance.update_imu_offset(track.T_c_m, fused.T_c_m)
            self.covariance.set_camera_rotation(self.motion.tracker.self_calibration.camera_rotation_rad)
        return fused, self.motion.take_events()

    def resume_after_loss(self, ctx: FrameContext, track: Track) -> None:
        """Tracked again after a loss: the map moves by the error of the prediction, the odometry frame stays.

        If the prediction was a guess, images have measured the motion over the loss, and nothing moves.
        """
        if self.pose.is_guess:
            return
        self.pose.T_m_c = ctx.T_m_c
        self.leave_map()
        self.pose.move_map(track.T_m_c)

    def set_measured(self, track: Track, dt_s: float, *, repeated: bool) -> None:
        """Take over a measured pose. repeated: the image was an old one."""
        self.pose.measured(track.T_m_c, dt_s, repeated=repeated)
        self.covariance.set_scale_sigma(self.motion.scale_sigma)
        self.covariance.update(track, dt_s)
        self.reference.set_camera(self.pose.T_m_c)

    def images_measured_motion(self, found: Relocalisation, *, was_lost: bool) -> bool:
        """True if a relocalisation tells the motion since images were lost, and no sensor does.

        A flight that begins in motion, slow cameras, images without content: the prediction was a guess, and the
        odometry frame need not hold it against the images. After some frames (was_lost: not the first one) a place
        that a vehicle hardly reaches may be a wrong one.
        """
        near = found.submap == self.submaps.active and not (was_lost and self.covariance.far_relocalisation)
        return self.pose.is_guess and near and not found.from_cache

    def move_to(self, found: Relocalisation, ctx: FrameContext) -> None:
        """The camera moved from where images last measured it to where this frame was relocalised."""
        self.reference.return_to(found.keyframe, found.track.inliers, ctx.number)
        self.set_measured(found.track, 0.0, repeated=ctx.repeated)
        self._map.note_tracking(found.track.rows, found.track.inlier, ctx.number)
        self.covariance.confirm_relocalisation()

    def dead_reckon(self, ctx: FrameContext) -> bool:
        """Take over the predicted pose of a frame without a measured one. True while IMU or odometer can be trusted."""
        reckoned = self.motion.dead_reckon(ctx.T_m_c, ctx.t_ns)
        if not self.motion.running:
            self.gravity.doubt()
        if reckoned.told:
            self.pose.reckon(reckoned.T_m_c, ctx.dt_s)
        else:
            self.pose.guess(reckoned.T_m_c, ctx.dt_s)
        self.reference.set_camera(self.pose.T_m_c)
        self.covariance.dead_reckon(ctx.dt_s, reckoned.cov, self.pose.measured_over_s)
        return reckoned.trusted

    def align_gravity(self, t_ns: int) -> GravityAlignment | None:
        """Estimate the vertical; a record, once, if the active submap is tilted: it is the first one, or continues it.

        Not while lengths are not metres: accelerations tell nothing then, and no pose that has to be upright is sent.
        """
        if not self.motion.metric:
            return None
        opened = self.submaps.opened
        continued = opened == 1 or (opened == 2 and self._T_o_first is not None)
        return self.gravity.update(t_ns, self.T_m_b, self.pose.T_o_m, self.submaps.active, continued=continued)

    def first_aligned(self, alignment: GravityAlignment) -> GravityAlignment:
        """How the first submap is tilted, by which the base aligns its world, where the active one continues it."""
        T_o_first = self._T_o_first
        if T_o_first is None or alignment.submap == self.submaps.first:
            return alignment
        up = T_o_first[:3, :3].T @ self.pose.T_o_m[:3, :3] @ alignment.T_l_m[2, :3]
        here = se3.transform(se3.inverse(T_o_first), (self.pose.T_o_m @ self.T_m_b)[None, :3, 3])[0]
        return upright_about(self.submaps.first, level_rotation(up), here)

    # changes of the map under the camera; the odometry frame stays still

    def leave_map(self) -> None:
        """Carry the covariance over to the odometry frame, before the map changes under the camera."""
        self.covariance.before_map_change(self.pose, self.T_c_b, self.submaps.active)

    def move_map(self, T_m_c: F64, growth: float = 1.0) -> None:
        """The map moved: the camera is at T_m_c (4,4) in it now. growth: factor of lengths around it."""
        before = self.pose.T_m_c
        self.pose.move_map(T_m_c)
        self.motion.move_map(se3.orthonormalise(self.pose.T_m_c @ se3.inverse(before)), growth)
        self.reference.set_camera(self.pose.T_m_c)

    def follow_corrections(self, motion: MapMotion | None) -> None:
        """The base moved the local map: move with it, or with the reference keyframe if its motion is not known."""
        if motion is not None:
            self.move_map(motion.T_new_old @ self.pose.T_m_c, motion.growth)
        elif self.reference.T_m_k is not None:
            self.move_map(self.reference.T_m_k @ self.reference.T_k_c)
        else:
            return
        self.covariance.apply_refinement(self.pose)

    def correct_disparities(self, change: F64) -> None:
        """The disparity offset of the map changed by (5,) px: move keyframes and camera by its effect."""
        self.leave_map()
        shift = self.covariance.correct_disparities(change)
        self.move_map(se3.orthonormalise(se3.exp(shift) @ self.pose.T_m_c))

    def return_to(self, found: Relocalisation, frame_number: int) -> None:
        """Continue in the submap in which the frame was relocalised."""
        self.leave_map()
        if found.submap != self.submaps.active:
            self._return_to_unit(found.submap)
        self.submaps.return_to(found.submap)
        self._map.activate(found.submap)
        self.reference.return_to(found.keyframe, found.track.inliers, frame_number)
        self.pose.move_map(se3.inverse(found.T_c_m))
        self.reference.set_camera(self.pose.T_m_c)
        self._map.note_tracking(found.track.rows, found.track.inlier, frame_number)
        if found.from_cache:
            self.covariance.relocalise(found.keyframe, found.T_c_m, found.track.inliers)
        else:
            self.covariance.update(found.track)
        self.covariance.confirm_relocalisation()

    def _return_to_unit(self, submap: SubmapId) -> None:
        """Measure in the unit of an older submap again."""
        if submap in self._own_units:
            self.motion.begin_unscaled_map(self._own_units[submap])
        elif not self.motion.metric:
            self.motion.return_to_metres()

    # new submaps

    def set_first_pose(self, imu: ImuBatch | None) -> None:
        """Set the camera where the flight begins: body at the origin, z up."""
        self.pose.T_m_c = self.gravity.first_pose(imu)

    def ignore_imu(self) -> None:
        """Go on as without an IMU: its samples contradict the images. Before there is a submap."""
        self.motion.ignore_imu()
        self.gravity.ignore_imu()

    def set_first_gravity(self, gravity_b: F64) -> None:
        """Set the camera where the flight begins: body at the origin, z up. gravity_b: (3,) in the body."""
        self.pose.T_m_c = self._upright(gravity_b)

    def _upright(self, gravity_b: F64) -> F64:
        return np.asarray(se3.from_rt(level_rotation(-gravity_b), np.zeros(3)) @ se3.inverse(self.T_c_b))

    def continue_in_metres(self, unit_m: float) -> F64:
        """Begin a new submap in this tracked frame. unit_m: m, one unit of the old one. Returns T_new_old (4,4).

        One that follows a map in a unit of its own lies as that one does, which the base scales alike: live poses are
        in the base's world at once.
        """
        self.leave_map()
        if self.submaps.opened == 1:
            self._T_o_first = self.pose.T_o_m.copy()
        if self.motion.in_metres or unit_m == 1.0:
            return self.pose.rescale(unit_m)
        self.pose.rescale_map(unit_m)
        return np.eye(4)

    @property
    def had_metres(self) -> bool:
        """True if a submap of this flight is in metres."""
        return self._had_metres

    def begin_metres(self) -> None:
        """The next submap is in metres. Before the first such one, errors of the motion are in no known unit."""
        if not self._had_metres and self.submaps.any:
            self.covariance.begin_flight()
        self._had_metres = True

    def begin_upright(self, gravity_b: F64) -> None:
        """Begin a submap as a flight does: body at its origin, z up. The odometry frame stays. gravity_b: (3,)."""
        self.leave_submap()
        self.pose.move_map(self._upright(gravity_b))

    def leave_submap(self) -> None:
        """Leave the active submap for a new one that begins here."""
        self.leave_map()
        self.pose.enter_submap()

    def open_submap(self, *, metric: bool = True) -> SubmapId:
        """Open a submap at the present pose. metric: its unit is a metre."""
        self.covariance.begin_submap(self.T_m_b, self.pose.T_o_m)
        submap = self.submaps.open_next()
        if not metric:
            self._own_units[submap] = self.motion.rough_unit
        self._map.activate(submap)
        return submap

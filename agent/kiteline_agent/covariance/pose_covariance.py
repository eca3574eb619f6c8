"""Covariance of the pose: accumulated noise, calibration errors shared by the whole flight, and dead reckoning.

- *Noise* accumulates from keyframe to keyframe: a pose has the noise of the keyframes whose landmarks it was measured
  against, plus that of its own measurement. A revisited place is as certain as its old keyframes.
- *Calibration errors* are the same in every frame, so they bend and stretch the whole map instead of averaging out.
  Only their effect on each keyframe is tracked (S. F. Schmidt's consider filter, 1966; for maps J. Civera et al.,
  "Drift-free real-time sequential mosaicing"). Residuals tell whether they are those of a good calibration or of a worn
  one. A disparity offset that was found (`disparity_alignment`) moves the keyframes back by its effect.
- *IMU bias on poses*: the mean offset between poses fused with the IMU and those from images alone.
- *Scale of one camera*: all lengths of its map err by the same share (`scale_error`).
- *Dead reckoning* has the covariance of the IMU or odometer, or that of unknown accelerations.
"""

import math

import numpy as np

from kiteline_agent.config import CovarianceConfig
from kiteline_agent.covariance.calibration_error_kernels import (
    CALIBRATION,
    DISPARITY_SHAPES,
    SHAPES,
    adjoint,
    from_body,
    pose_covariance,
    sensitivity,
)
from kiteline_agent.covariance.calibration_evidence import CalibrationEvidence, good_covariance
from kiteline_agent.covariance.evaluation_schedule import EvaluationSchedule
from kiteline_agent.covariance.odometry_drift import covariance_by_map
from kiteline_agent.covariance.pose_quality import LOST_BELOW, probability_good
from kiteline_agent.covariance.scale_error import ScaleError
from kiteline_agent.covariance.unmeasured_motion import unmeasured_growth
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import SEQUENCE_BITS, KeyframeId, SubmapId

_CACHE_PX = 1.0  # px, error of a corner at octave 0 that matched a landmark of the map cache
_CACHE_DEPTH_M = 4.0  # typical depth of such corners
_MOUNT = 2.0  # growth of the error of the extrinsic rotation with that of the lenses: .15 degrees an axis if worn
_WORN_LENS_PX = 0.8  # px at the image's edge: focal length and centre of a worn lens
_WORN_MOUNT_RAD = 3e-3  # rad: rotation of the camera in the body about an axis, if worn
_IMU_OFFSET_SHARE = 1.0  # of the mean difference: standard deviation of its systematic part
_REFINED_SHARE = 0.25  # of a keyframe's variance that remains when the base has optimised it
_FEW_INLIERS = 10  # inliers with which quality begins to rise: so many agree by chance
_MANY_INLIERS = 30  # inliers with which quality is not reduced
_SURPRISE = 7.0  # standard deviations between a relocalised pose and the IMU's prediction, at most
_SURPRISE_UNMEASURED = 10.0  # the same if nothing measured the motion: 2 g all the time
_FAR_DEVIATIONS = 4.0  # the same beyond which a relocalised pose has low quality at first: nearly 1 g
_LOW_QUALITY_S = 0.98  # s of that low quality, in which a wrong place fails to track
_SURPRISE_M = 0.1  # m: standard deviation added to that comparison, since maps are corrected meanwhile
_SURPRISE_RAD = 0.05  # rad: the same for the rotation


class PoseCovariance:
    """Covariance and quality of the pose. Call `update` or `dead_reckon` once a frame.

    Perturbations act on the left of poses in m (or o), [translation, rotation].
    """

    def __init__(self, local_map: LocalMap, T_b_c: F64, config: CovarianceConfig, *, has_body: bool, has_depth: bool):
        """has_body: the camera has calibrated extrinsics. has_depth: stereo or a depth camera."""
        self._map = local_map
        self._T_b_c = T_b_c
        self._config = config
        slots = len(local_map.keyframe)
        self._noise_k, self._shift_k = np.zeros((slots, 6, 6)), np.zeros((slots, 6, SHAPES))  # of each keyframe
        self._refined = np.zeros(slots, np.bool_)
        self._good_variance = np.full(CALIBRATION, config.calibration_px**2)
        self._good_variance[:DISPARITY_SHAPES] *= 2.0 if has_depth else 0.0  # a disparity has the errors of two cameras
        self._calibration = np.diag([*self._good_variance, _IMU_OFFSET_SHARE**2])
        self._evidence = CalibrationEvidence(self._good_variance)
        self._disparity_error: F64 | None = None  # as set last
        self._worn = 0.0  # probability of a worn rig
        self._good_information = np.zeros((DISPARITY_SHAPES, DISPARITY_SHAPES))  # see set_disparity_error
        self._worn_cov = np.zeros((CALIBRATION, CALIBRATION))  # beyond a good calibration
        half = 0.5 * local_map.camera.width / local_map.camera.fx  # edge of the image, normalised
        self._at_edge = np.array([1.0, half, half, half**2, half**2])  # px there for a pixel of each term of an offset
        self._roll = 1.0  # share of the variance of disparities along y that the right camera's rows allow
        self._has_body = has_body
        self._camera_rotation_rad = 0.0  # found against the IMU
        self._extrinsic = self._extrinsic_cov()
        self._noise, self._shift = np.zeros((6, 6)), np.zeros((6, SHAPES))  # of the camera in m
        self._T_o_m_before: dict[SubmapId, F64] = {}  # of submaps that were left, while all motion since was measured
        self._has_imu_motion = False  # an IMU measures all motion
        self._metric = has_depth
        self.far_relocalisation = False  # the last one is far from the predicted pose
        self._doubtful_s = 0.0  # for which such a relocalisation still has low quality
        self._imu_offset = np.zeros(6)  # mean offset of fused poses from those of images, on the left of T_c_m
        self._imu_offset_cov = np.zeros((6, 6))  # its covariance
        self._unmeasured_s: float | None = 0.0  # time without any measured motion; None: the last frame was measured
        self._reckoned = np.zeros((6, 6))  # of dead reckoning, [translation in m, rotation about the body's axes]
        self._carried = np.zeros((6, 6))  # of the submap in o
        self._zero = np.zeros((6, 6))
        self._same_frame = True  # o is the submap's own frame
        self._schedule = EvaluationSchedule()
        self._track: Track | None = None  # of this frame, if not evaluated yet
        self._T_m_b0: F64 = np.eye(4)  # first pose of the submap
        self._T_o_b0: F64 | None = None  # first pose of the flight
        self._T_o_b_left: F64 | None = None  # where the map last changed
        self._scale = ScaleError()
        self._h, self._g = np.zeros((6, 6)), np.zeros((6, SHAPES))
        self._of_errors, self._side = np.zeros((CALIBRATION, CALIBRATION)), np.zeros(6 + CALIBRATION)

    # updates

    def begin_flight(self) -> None:
        """Forget how uncertain the motion so far is: poses count from the submap that begins next."""
        self._carried = np.zeros((6, 6))
        self._T_o_b0 = self._T_o_b_left = None
        self._T_o_m_before = {}

    def begin_submap(self, T_m_b: F64, T_o_m: F64) -> None:
        """Begin a submap, with its first keyframe at T_m_b (4,4). T_o_m: (4,4) of it in the odometry frame."""
        self._noise, self._shift = np.zeros((6, 6)), np.zeros((6, SHAPES))
        self._reset_reckoning()
        self._unmeasured_s = 0.0
        self._T_m_b0 = T_m_b
        self._schedule.begin((T_m_b @ self._T_b_c)[:3, 3])
        if self._T_o_b0 is None:
            self._T_o_b0, self._same_frame = T_o_m @ T_m_b, np.array_equal(T_o_m, np.eye(4))
        self._scale.begin_map(T_m_b[:3, 3], (self._T_o_b0 if self._T_o_b_left is None else self._T_o_b_left)[:3, 3])

    def update(self, track: Track, dt_s: float = 0.0) -> None:
        """Update after images gave the pose, from landmarks of the local map. dt_s: since the last such frame.

        As a perturbation on the left, the covariance changes slowly: it is evaluated for every keyframe, after every
        frame without a pose from images, and when the schedule says so.
        """
        self._doubtful_s = max(self._doubtful_s - dt_s, 0.0)
        if not self._schedule.is_due(track) and self._unmeasured_s is None:
            self._track = track
            return
        self._evaluate(track)

    def update_imu_offset(self, seen_T_c_m: F64, T_c_m: F64) -> None:
        """Update the statistics of the difference between the image pose (4,4) and the pose fused with the IMU (4,4).

        It is larger than both covariances predict, so it is measured (R. Mehra, "On the identification of variances
        and adaptive Kalman filtering", 1970). Its mean is the same in all keyframes and accumulates like a calibration
        error; the rest is noise.
        """
        X = T_c_m @ se3.inverse(seen_T_c_m)
        d = np.array([X[0, 3], X[1, 3], X[2, 3], X[2, 1], X[0, 2], X[1, 0]])
        share = 1.0 / self._config.imu_offset_frames
        self._imu_offset += share * (d - self._imu_offset)
        d -= self._imu_offset
        self._imu_offset_cov += share * (np.outer(d, d) - self._imu_offset_cov)

    def set_camera_rotation(self, angle_rad: float) -> None:
        """Set by which angle the camera was found to be rotated against the body, which poses do not correct."""
        if angle_rad != self._camera_rotation_rad:
            self._camera_rotation_rad = angle_rad
            self._extrinsic = self._extrinsic_cov()

    def set_scale_sigma(self, sigma: float) -> None:
        """Set the relative deviation of lengths in the map of one camera; 0 if cameras measure them, or none does."""
        self._scale.sigma = sigma

    def _extrinsic_cov(self) -> F64:
        """(6,6) of the camera in the body."""
        if not self._has_body:
            return np.zeros((6, 6))
        # what wears the lenses wears their mount, too
        mount = self._config.extrinsic_rad * (1.0 + _MOUNT * (self._evidence.level - 1.0))
        rotation = mount**2 + self._worn * _WORN_MOUNT_RAD**2 + self._camera_rotation_rad**2 / 3.0
        a = adjoint(self._T_b_c)
        return np.asarray(a @ np.diag(np.repeat([self._config.extrinsic_m**2, rotation], 3)) @ a.T)

    def _evaluate(self, track: Track) -> None:
        m = self._map
        sensitivity(
            track.T_c_m, m.intrinsics, 0.5 * m.camera.width, track.rows, track.inlier, track.xyz, track.ray,
            track.observed, track.sigma_px, m.slot_size, m.T_m_k, m.uv.reshape(-1, 2), m.rho.reshape(-1), self._shift_k,
            self._h, self._g, self._of_errors, self._side,
        )  # fmt: skip
        if self._evidence.add(self._h, self._g, self._of_errors, self._side):
            self._set_calibration()
        inverse = np.linalg.inv(self._h + 1e-6 * np.eye(6))
        a = adjoint(se3.inverse(track.T_c_m))
        noise = max(track.rms, self._config.least_rms) ** 2 * inverse
        seen = np.bincount(track.rows[track.inlier] // m.slot_size)
        slots = np.flatnonzero(seen)
        share = seen[slots] / max(int(seen.sum()), 1)
        self._noise = a @ (noise + self._imu_offset_cov) @ a.T + np.tensordot(share, self._noise_k[slots], 1)
        self._shift = a @ (inverse @ self._g)
        self._shift[:, CALIBRATION] -= a @ self._imu_offset
        self._schedule.evaluated(track)
        self._reset_reckoning()

    def _reset_reckoning(self) -> None:
        """Clear the covariance of dead reckoning, since the pose is known again."""
        self._reckoned, self._unmeasured_s, self._track = np.zeros((6, 6)), None, None

    def store(self, keyframe: KeyframeId) -> None:
        """Store the covariance of this frame, which became a keyframe."""
        if self._track is not None:
            self._evaluate(self._track)
        slot = self._map.slot_of(keyframe)
        self._noise_k[slot], self._shift_k[slot], self._refined[slot] = self._noise, self._shift, False

    def dead_reckon(self, dt_s: float, sensor_cov: F64 | None, over_s: float | None = 0.0) -> None:
        """Update after another dt_s without a pose from images.

        sensor_cov: (6,6) of the pose by IMU or odometer, [translation in m, rotation about the body's axes]; None if
        no sensor measures the motion. over_s: s over which the velocity was measured; None: it is not known.
        """
        self._unmeasured_s = self._unmeasured_s or 0.0
        if sensor_cov is not None:
            self._reckoned = sensor_cov
            return
        self._reckoned = self._reckoned + self.unmeasured_growth(dt_s, over_s)
        self._unmeasured_s += dt_s

    def unmeasured_growth(self, dt_s: float, over_s: float | None) -> F64:
        """Covariance (6,6) that unknown accelerations add in dt_s without measured motion, from now on."""
        before_s = self._unmeasured_s or 0.0
        return unmeasured_growth(self._config, before_s, before_s + dt_s, over_s)

    def dead_reckoning_within(self, m: float, rad: float) -> bool:
        """True if dead reckoning has a standard deviation up to m in any direction and rad about any axis."""
        sigma_m, sigma_rad = self.dead_reckoning_sigma
        return sigma_m <= m and sigma_rad <= rad

    @property
    def dead_reckoning_sigma(self) -> tuple[float, float]:
        """Largest standard deviations of dead reckoning since images were lost: m in a direction, rad about an axis."""
        blocks = self._reckoned[:3, :3], self._reckoned[3:, 3:]
        of_m, of_rad = (float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) for block in blocks)
        return of_m, of_rad

    def extend_map(self, T_m_b: F64) -> None:
        """Continue the map with a keyframe at T_m_b (4,4), a pose by dead reckoning."""
        back = from_body(T_m_b)
        self._noise = self._noise + back @ self._reckoned @ back.T
        self._reset_reckoning()
        self._unmeasured_s = 0.0

    def relocalise(self, keyframe: KeyframeId, T_c_m: F64, points: int) -> None:
        """Update after a relocalisation near `keyframe` at T_c_m (4,4), from `points` landmarks of the map cache."""
        slot = self._map.slot_of(keyframe)
        depth_m, focal_px = _CACHE_DEPTH_M, self._map.camera.fx
        turn = _CACHE_PX / focal_px / math.sqrt(max(points, 4))
        own = np.diag(np.repeat([turn * depth_m, turn], 3) ** 2)
        a = adjoint(se3.inverse(T_c_m))
        self._noise, self._shift = self._noise_k[slot] + a @ own @ a.T, self._shift_k[slot].copy()
        self._reset_reckoning()
        self._unmeasured_s = 0.0

    def before_map_change(self, pose: PoseState, T_c_b: F64, submap: SubmapId) -> None:
        """Move the covariance into the odometry frame, before the map of the active submap changes."""
        if self._has_imu_motion or self._metric:
            self._T_o_m_before[submap] = pose.T_o_m
        T_m_b = pose.T_m_c @ T_c_b
        left, out = np.empty((6, 6)), np.empty((6, 6))
        self._propagate(pose.T_o_m, T_m_b, np.eye(4), left, out)
        # dead reckoning is perturbed in the body, the rest on the left
        T_o_b = self._T_o_b_left = pose.T_o_m @ T_m_b
        back, turn = from_body(T_o_b), np.eye(6)
        turn[:3, :3] = pose.T_o_m[:3, :3]
        reckoned = back @ turn @ self._reckoned @ turn.T @ back.T
        self._carried, self._same_frame = left + reckoned, False

    def apply_refinement(self, pose: PoseState) -> None:
        """Reduce the noise of keyframes that the base optimised for the first time."""
        m = self._map
        new = m.from_base & ~self._refined & (self._noise_k[:, 0, 0] > 0.0)
        if not new.any():
            return
        self._refined |= new
        lost = 1.0 - _REFINED_SHARE
        self._noise_k[new] *= _REFINED_SHARE
        # the odometry frame does not gain accuracy by it
        self._same_frame = False
        a = adjoint(pose.T_o_m)
        self._carried = self._carried + lost * a @ self._noise @ a.T
        self._noise = self._noise * _REFINED_SHARE

    def correct_disparities(self, offset: F64) -> F64:
        """Move keyframes by a change (5,) px of the disparity offset; how the camera moves in m, on the left (6,)."""
        m, errors = self._map, np.zeros(SHAPES)
        errors[:DISPARITY_SHAPES] = self._at_edge * offset
        slots = np.flatnonzero(m.keyframe >> SEQUENCE_BITS == m.active)
        m.held.note_motion(m.active, m.keyframe, m.parent, m.T_m_k)
        m.held.offsets.add(offset, m.keyframe[slots], -self._shift_k[slots] @ errors)
        for slot in slots:
            m.T_m_k[slot] = se3.orthonormalise(se3.exp(-self._shift_k[slot] @ errors) @ m.T_m_k[slot])
        m.relate_to_parents()
        self._evidence = CalibrationEvidence(self._good_variance)
        self._set_calibration()
        return np.asarray(-self._shift @ errors)

    def set_disparity_error(self, cov: F64, worn: float, good_information: F64) -> None:
        """Set the covariance (5,5) px^2 of the map's disparity offset, the probability that the rig is worn, and the
        information (5,5) 1/px^2 on which the offset rests if it is a good calibration's.
        """
        if cov is not self._disparity_error:
            self._disparity_error = cov
            at_edge, lens = self._at_edge, np.arange(DISPARITY_SHAPES, CALIBRATION - 1)
            self._worn_cov[:DISPARITY_SHAPES, :DISPARITY_SHAPES] = at_edge[:, None] * cov * at_edge
            self._worn_cov[lens, lens] = worn * _WORN_LENS_PX**2
            self._worn, self._good_information = worn, good_information / np.outer(at_edge, at_edge)
            self._set_calibration()

    def set_roll(self, rms_px: float) -> None:
        """Set the rms slope of the right camera's rows along x, px where x is 1: its roll tilts disparities as much."""
        before, self._roll = self._roll, min((self._at_edge[2] * rms_px) ** 2 / self._good_variance[2], 1.0)
        if before != self._roll:
            self._set_calibration()

    def _set_calibration(self) -> None:
        variance = self._good_variance * self._evidence.level**2
        good = good_covariance(variance, self._roll, self._worn, self._good_information)
        self._calibration[:CALIBRATION, :CALIBRATION] = good + self._worn_cov
        self._extrinsic = self._extrinsic_cov()

    # results

    def of_poses(self, pose: PoseState, T_m_b: F64, *, in_first: bool = False) -> tuple[F64, F64]:
        """Covariances (6,6) of T_m_b relative to the start of its submap and of T_o_b relative to that of the flight.

        Each is [translation in m or o, rotation about the body's axes]. in_first: the submap is that in which the
        flight began, so that the drift of the odometry frame is measured in it.
        """
        cov_m, cov_o = self._without_scale(pose, T_m_b, in_first=in_first)
        if self._scale.sigma == 0.0:
            return cov_m, cov_o
        of_m, of_o = np.zeros((6, 6)), np.zeros((6, 6))
        p_m_b = T_m_b[:3, 3]
        at_m, at_o = self._scale.in_m(p_m_b), self._scale.in_o(se3.transform(pose.T_o_m, p_m_b[None])[0])
        of_m[:3, :3], of_o[:3, :3] = np.outer(at_m, at_m), np.outer(at_o, at_o)
        return cov_m + of_m, cov_o + of_o

    def _without_scale(self, pose: PoseState, T_m_b: F64, *, in_first: bool) -> tuple[F64, F64]:
        """The same without the error of a monocular map's scale."""
        left, cov_m = np.empty((6, 6)), np.empty((6, 6))
        carried, self._carried = self._carried, self._zero
        self._propagate(np.eye(4), T_m_b, self._T_m_b0, left, cov_m)
        self._carried = carried
        if self._same_frame:
            return cov_m, cov_m
        cov_o = np.empty((6, 6))
        self._propagate(pose.T_o_m, T_m_b, self._T_m_b0 if self._T_o_b0 is None else self._T_o_b0, left, cov_o)
        if in_first and self._unmeasured_s is None:
            by_map = covariance_by_map(cov_m, pose.T_o_m, T_m_b)
            if np.trace(by_map[:3, :3]) < np.trace(cov_o[:3, :3]):
                return cov_m, by_map
        return cov_m, cov_o

    def _propagate(self, T_a_m: F64, T_m_b: F64, T_a_b0: F64, left: F64, out: F64) -> None:
        pose_covariance(
            self._noise, self._shift, self._calibration, self._carried, self._reckoned, self._extrinsic,
            np.ascontiguousarray(T_a_m), np.ascontiguousarray(T_m_b), np.ascontiguousarray(T_a_b0), left, out,
        )  # fmt: skip

    def set_imu_motion(self, *, measured: bool) -> None:
        """Set whether an IMU has measured the motion since the last frame."""
        self._has_imu_motion = measured
        if not measured and not self._metric:
            self._T_o_m_before = {}  # monocular maps differ in scale

    def is_consistent(
        self, T_c_m: F64, submap: SubmapId, predicted_T_m_c: F64, pose: PoseState, T_c_b: F64, active: SubmapId,
        *, relocalised: bool,
    ) -> bool:  # fmt: skip
        """Test if T_c_m (4,4) in a submap agrees with the measured path since the vehicle was there.

        Without a sensor for the path, tests if a vehicle can fly there in the time. relocalised: the pose comes from
        relocalisation, not from tracking.
        """
        self.far_relocalisation = False
        T_o_m = pose.T_o_m if submap == active else self._T_o_m_before.get(submap)
        if T_o_m is None or not (self._has_imu_motion or (relocalised and self._metric)):
            return True
        here, there = pose.T_o_m @ predicted_T_m_c, T_o_m @ se3.inverse(T_c_m)
        away_m = float(np.abs(there[:3, 3] - here[:3, 3]).sum())
        turned = 0.5 * (3.0 - float(np.vdot(here[:3, :3], there[:3, :3])))  # 1 - cos
        if away_m < _SURPRISE_M and turned < 0.5 * _SURPRISE_RAD**2:
            return True
        if not self._has_imu_motion and submap == active and self._unmeasured_s is None:
            return True  # images were lost in this very frame
        here, there = here @ T_c_b, there @ T_c_b
        e = np.concatenate([there[:3, 3] - here[:3, 3], se3.so3_log(here[:3, :3].T @ there[:3, :3])])
        cov = self.of_poses(pose, pose.T_m_c @ T_c_b)[1] + np.diag(np.repeat([_SURPRISE_M, _SURPRISE_RAD], 3) ** 2)
        apart = math.sqrt(float(e @ np.linalg.solve(cov, e)))
        if self._has_imu_motion:
            return apart < _SURPRISE
        self.far_relocalisation = apart >= _FAR_DEVIATIONS
        return apart < _SURPRISE_UNMEASURED

    def confirm_relocalisation(self) -> None:
        """Accept the last consistent relocalisation; if it is far from the prediction, its quality is low at first."""
        self._doubtful_s = _LOW_QUALITY_S if self.far_relocalisation else 0.0

    def quality(self, cov: F64, inliers: int | None) -> int:
        """Probability in percent, at least 1, that a pose of covariance cov (6,6) is good, as configured.

        inliers: None if the pose comes from dead reckoning.
        """
        c = self._config
        counted = _MANY_INLIERS if inliers is None else inliers
        trust = min(max((counted - _FEW_INLIERS) / (_MANY_INLIERS - _FEW_INLIERS), 0.0), 1.0)
        most = 100 if self._doubtful_s == 0.0 else LOST_BELOW - 1
        return min(max(1, round(100.0 * trust * probability_good(cov, c.good_m, c.good_rad))), most)

    def dead_reckoning_quality(self) -> int:
        """The same for what dead reckoning alone added since images were lost."""
        return self.quality(self._reckoned, None)

"""Reports the pose of each processed frame, and predicts it for the time after that frame."""

import numpy as np

from kiteline_agent.covariance.pose_quality import LOST_BELOW
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.mapping.loss_stage import FrameOutcome
from kiteline_agent.motion.extrapolation import MotionSource
from kiteline_agent.motion.recent_motion import RecentMotion
from kiteline_agent.step import Estimate, PredictedPose
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import LivePose
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, AgentId


class PoseReport:
    """Composes estimates from the state of the camera."""

    def __init__(
        self, agent: AgentId, camera: CameraState, corrections: Corrections, channel: RecordChannel, *, has_depth: bool
    ) -> None:
        self._agent, self._camera, self._corrections, self._channel = agent, camera, corrections, channel
        self._has_depth = has_depth
        self._last: Estimate | None = None
        self._T_w_b: F64 | None = None  # of the last frame, as corrected last
        self._recent = RecentMotion()

    def report(self, ctx: FrameContext, outcome: FrameOutcome) -> Estimate:
        """The estimate of a frame; shares the live pose with the base."""
        camera = self._camera
        initialising = not camera.submaps.any or camera.motion.awaits_scale
        tracked = outcome.tracked and not initialising
        submap, T_m_b, T_o_m = camera.submaps.active, camera.T_m_b, camera.pose.T_o_m
        in_first = self._has_depth and camera.submaps.in_first
        cov_m, cov_o = camera.covariance.of_poses(camera.pose, T_m_b, in_first=in_first)
        quality = camera.covariance.quality(
            cov_m if tracked and self._knows_place() else cov_o, outcome.inliers or None
        )
        carried = camera.submaps.any and camera.motion.measures_motion
        lost = not carried or camera.covariance.dead_reckoning_quality() < LOST_BELOW
        if not tracked and (initialising or lost):
            quality = -1
        keyframe, T_k_c = camera.reference.keyframe, camera.reference.T_k_c
        if keyframe != NO_KEYFRAME:
            self._channel.put(LivePose(self._agent, ctx.t_ns, keyframe, T_k_c, quality))
        if outcome.T_o_n is not None:
            self._corrections.relocalise(outcome.T_o_n)
        T_w_b = self._corrections.in_world(submap, T_m_b, T_o_m, ctx.t_ns, metric=camera.motion.in_metres)
        self._T_w_b = None
        if tracked and T_w_b is not None:
            in_base_map = self._corrections.in_base_map(submap, T_m_b)
            self._T_w_b = T_w_b if in_base_map is None else in_base_map
        self._last = Estimate(
            ctx.t_ns, tracked, outcome.bridged, T_m_b if tracked else None, T_o_m @ T_m_b, keyframe, T_k_c.copy(),
            submap, outcome.inliers, quality, cov_m, cov_o, camera.gravity.R_l_o, T_w_b if tracked else None,
            initialising, camera.gravity.p_l_o,
        )  # fmt: skip
        self._recent.add(ctx.t_ns, self._last.T_o_b, measured=tracked and not outcome.bridged)
        return self._last

    def _knows_place(self) -> bool:
        """True if the active submap's pose in the flight's first one rests on more than odometry.

        Always in flights without metres, of whose maps each has a unit of its own.
        """
        submaps = self._camera.submaps
        return not self._camera.had_metres or submaps.in_first or self._corrections.is_recognised(submaps.active)

    def odometry_quality(self, estimate: Estimate) -> int:
        """`quality` of T_o_b, which no map corrects: for a flight controller."""
        return min(estimate.quality, self._camera.covariance.quality(estimate.cov_o, None))

    def in_base_map(self, T_o_b: F64) -> F64 | None:
        """T_w_b (4,4) of a pose since the last frame, for the base's tiles; None while that frame's is not known.

        Not smoothed as live poses are: the base draws tiles where its map lies now.
        """
        if self._last is None or self._T_w_b is None:
            return None
        return np.asarray(self._T_w_b @ se3.inverse(self._last.T_o_b) @ T_o_b)

    def predict(self, t_ns: int, imu: ImuBatch | None, max_s: float) -> PredictedPose | None:
        """Predict the pose at t_ns. imu: samples since the last frame. Changes no state.

        None before there is a map, at or before the last frame, and more than max_s after it.
        """
        last, camera = self._last, self._camera
        dt_s = 0.0 if last is None else (t_ns - last.t_ns) * 1e-9
        if last is None or last.initialising or not 0.0 < dt_s <= max_s:
            return None
        moved = camera.motion.extrapolate(t_ns, imu, dt_s)
        R_o_m, growth = camera.pose.T_o_m[:3, :3], moved.growth
        if growth is None:
            growth = camera.covariance.unmeasured_growth(dt_s, camera.pose.measured_over_s)
        turn = np.eye(6)
        turn[:3, :3] = R_o_m
        cov_o = last.cov_o + turn @ growth @ turn.T
        quality = min(last.quality, self.odometry_quality(last), camera.covariance.quality(cov_o, None))
        by_poses = self._recent.rates(t_ns) if moved.source is MotionSource.VELOCITY else None
        velocity, rate = by_poses or (R_o_m @ moved.velocity, moved.rate)
        return PredictedPose(
            t_ns, moved.source.value, last.tracked, camera.pose.T_o_m @ moved.T_m_b, velocity, rate, quality,
            cov_o, camera.gravity.R_l_o, camera.gravity.p_l_o,
        )  # fmt: skip

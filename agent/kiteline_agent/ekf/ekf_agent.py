"""The onboard half with the smallest tracker: one camera and odometry. Sans-IO; it is stepped like Agent."""

from typing import Any

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.covariance.pose_quality import probability_good
from kiteline_agent.ekf.corner_flow import CornerFlow
from kiteline_agent.ekf.ekf_slam import EkfSlam
from kiteline_agent.ekf.odometer_motion import OdometerMotion
from kiteline_agent.ekf.shared_keyframes import FilteredFrame, SharedKeyframes
from kiteline_agent.frame_order import FrameOrder
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.governor.governor import Governor
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.inertial.gravity_alignment import AHEAD
from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.motion.extrapolation import LEAST_PREDICTION_PERCENT, MAX_PREDICTION_S, MotionSource
from kiteline_agent.scans.local_grid import Surroundings
from kiteline_agent.step import Estimate, Identity, PredictedPose, StepInput, StepOutput
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import GridTile
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraRig, Rectifier
from kiteline_core.ids import SubmapId

_SILENT_NS = 1_000_000_000  # of an odometer, before the user is told


class EkfAgent:
    """Tracks one camera by the Kalman filter, and shares keyframes of its path with the base.

    The filter's frame is o: nothing but images and odometry corrects it. What the base corrects moves the submap m.
    """

    metric = in_metres = True  # lengths are those of the odometry

    def __init__(self, rig: CameraRig, config: AgentConfig, identity: Identity, channel: RecordChannel) -> None:
        self._config, self._channel = config, channel
        self._rectifier = Rectifier(rig)
        camera = self._rectifier.camera
        self.work = Work()
        # The body starts level, as its odometer has it; where none is known, the camera does, and looks ahead.
        T_o_b = np.eye(4) if rig.has_body else se3.from_rt(AHEAD, np.zeros(3))
        self._slam = EkfSlam(camera, config.ekf, T_o_b)
        self._T_c_b = se3.inverse(camera.T_b_c)
        self._R_l_o = np.eye(3)
        self._flow = CornerFlow(camera, config.detector, config.ekf)
        self._motion = OdometerMotion(camera.T_b_c, config.ekf, config.odometer.keep_s, config.odometer.max_gap_s)
        self._governor = Governor(config.governor)
        self._keyframes = SharedKeyframes(camera, config, identity, channel, self._governor, self.work)
        self._order = FrameOrder()
        self._last: Estimate | None = None
        self._frame_number = 0
        self._measured_ns: int | None = None  # the last frame whose motion the odometer measured, or the first one
        self._told = False  # that it has measured none since for a while

    def step(self, step_input: StepInput, now_ns: int) -> StepOutput:
        """Take in what arrived, track the frame if there is one and time for it. Never waits.

        A frame that is not newer than those before is left out, as in Agent.
        """
        self.work.clear()
        self.work.steps = 1
        records = self._channel.receive(step_input.packets, now_ns)
        events = self._keyframes.take(records, self._channel.take_removed())
        self._motion.add(step_input.odometry)
        estimate = predicted = None
        frame, late = self._order.newer(step_input.frame)
        events += late
        if frame is not None:
            # Odometry bridges skipped frames as an IMU does.
            decision = self._governor.frame(frame.t_ns, step_input.cpu_ns, carried=True)
            events += decision.events
            if decision.track:
                estimate, more = self._process(frame)
                events += more
            elif self._config.governor.cpu_percent >= LEAST_PREDICTION_PERCENT:
                predicted = self.predict(frame.t_ns)
        elif step_input.predict_ns is not None:
            predicted = self.predict(step_input.predict_ns)
        return StepOutput(estimate, tuple(self._channel.poll(now_ns)), tuple(events), predicted)

    def predict(self, t_ns: int) -> PredictedPose | None:
        """The pose at a time after the last frame; None too long after it."""
        last = self._last
        dt_s = 0.0 if last is None else (t_ns - last.t_ns) * 1e-9
        if last is None or not 0.0 < dt_s <= MAX_PREDICTION_S:
            return None
        T_o_b, twist = last.T_o_b @ self._motion.extrapolated(dt_s), self._motion.twist
        return PredictedPose(
            t_ns, MotionSource.VELOCITY.value, last.tracked, T_o_b, T_o_b[:3, :3] @ twist[:3], twist[3:].copy(),
            last.quality, last.cov_o, self._R_l_o,
        )  # fmt: skip

    def _process(self, frame: Frame) -> tuple[Estimate, list[str]]:
        """The algorithm of one frame. Returns the estimate and events."""
        left = self._rectifier.left(frame.left)
        self.work.frames = 1
        self.work.pyramid_px = self.work.detected_px = left.size
        self._frame_number += 1
        pyramid = build_pyramid(left, self._config.detector.levels)
        if self._last is not None:
            self._slam.predict(self._motion.between(self._last.t_ns, frame.t_ns))
        self._flow.follow(pyramid)
        self._flow.align(pyramid, self._slam.state.T_o_c, self._slam.depths(self._flow.ids))
        found = self._slam.update(self._flow.ids, self._flow.uv, self._flow.octave)
        self.work.alignments = 3 * len(self._flow.ids)
        self.work.posed_points = len(found.compatible)
        self._flow.drop(found.rejected)  # flow has slid off them
        self._flow.replenish(pyramid, self._slam.state.T_o_c)
        events = [f"{len(found.entered)} landmarks entered"] if len(found.entered) else []
        events += self._missing(frame.t_ns)
        inliers, flow, T_o_c = len(found.compatible), self._flow, self._slam.state.T_o_c
        depth_m = self._slam.depths(flow.ids)
        filtered = FilteredFrame(
            self._frame_number, frame.t_ns, pyramid, T_o_c, flow.ids, flow.uv, flow.octave, depth_m
        )  # fmt: skip
        events += self._keyframes.add(filtered, tracked=self._is_tracked(inliers))
        self._last = self._estimate(frame.t_ns, inliers)
        return self._last, events

    def _is_tracked(self, inliers: int) -> bool:
        """True if images or the odometer measured the last motion; at the first frame there is none."""
        return inliers >= self._config.pose.min_inliers or self._motion.measured or self._last is None

    def _missing(self, t_ns: int) -> list[str]:
        """An event, once, when the odometer has been silent for a while."""
        if self._motion.measured or self._measured_ns is None:
            self._measured_ns, self._told = t_ns, False
        elif not self._told and t_ns - self._measured_ns >= _SILENT_NS:
            self._told = True
            return ["odometer: no samples arrive; the Kalman filter flies by them (--tracker map needs none)"]
        return []

    def _estimate(self, t_ns: int, inliers: int) -> Estimate:
        """The estimate of a frame; shares the live pose with the base."""
        T_o_b = se3.orthonormalise(self._slam.state.T_o_c @ self._T_c_b)
        cov = self._slam.state.pose_covariance(self._T_c_b)
        limits, keyframes = self._config.covariance, self._keyframes
        tracked = self._is_tracked(inliers)
        bridged = tracked and inliers < self._config.pose.min_inliers
        quality = max(1, round(100.0 * probability_good(cov, limits.good_m, limits.good_rad))) if tracked else -1
        keyframes.share_pose(t_ns, quality)
        T_w_b = keyframes.in_world(T_o_b, t_ns)
        return Estimate(
            t_ns, tracked, bridged, keyframes.T_m_o @ T_o_b if tracked else None, T_o_b, keyframes.keyframe,
            keyframes.T_k_c.copy(), self.submap, inliers, quality, cov, cov, self._R_l_o, T_w_b if tracked else None,
        )  # fmt: skip

    # what is known

    @property
    def submap(self) -> SubmapId:
        """The submap in which the camera is tracked."""
        return self._keyframes.submap

    @property
    def left_out(self) -> int:
        """Frames that were left out, as they were not newer than those before."""
        return self._order.left_out

    @property
    def tiles(self) -> dict[tuple[int, int], GridTile]:
        """Tiles of the base's grid, by column and row."""
        return self._keyframes.tiles

    def surroundings(self, _pose: Estimate | PredictedPose, _T_b_f: F64) -> Surroundings | None:
        """None: it makes no scans."""
        return None

    def odometry_quality(self, estimate: Estimate) -> int:
        """`quality` of T_o_b."""
        return estimate.quality

    def known_rig(self) -> KnownRigConfig | None:
        """None: it measures no rig."""
        return None

    def motion_reports(self) -> dict[str, Any]:
        """What was found of the odometer; None for what is not there."""
        return {
            "time_offset": None, "imu_calibration": None, "readout": None,
            "odometer": {"scale": round(self._slam.state.scale, 4)} if self._motion.measured else None,
        }  # fmt: skip

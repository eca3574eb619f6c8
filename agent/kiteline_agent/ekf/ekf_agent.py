"""The onboard half with the smallest tracker: one camera and odometry, no base. Sans-IO.

It is stepped like Agent. Its keyframes and landmarks are not shared yet.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.covariance.pose_covariance import probability_good
from kiteline_agent.ekf.corner_flow import CornerFlow
from kiteline_agent.ekf.ekf_slam import EkfSlam
from kiteline_agent.ekf.odometer_motion import OdometerMotion
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.inertial.gravity_alignment import AHEAD
from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.motion.extrapolation import MotionSource
from kiteline_agent.scans.local_grid import Surroundings
from kiteline_agent.step import Estimate, Identity, PredictedPose, StepInput, StepOutput
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import GridTile
from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraRig, Rectifier
from kiteline_core.ids import NO_KEYFRAME, SubmapId

F64 = NDArray[np.float64]

_SILENT_NS = 1_000_000_000  # of an odometer, before the user is told


class EkfAgent:
    """Tracks one camera by the Kalman filter. m is o: nothing but the filter corrects its map."""

    metric = True  # lengths are those of the odometry

    def __init__(self, rig: CameraRig, config: AgentConfig, identity: Identity, channel: RecordChannel) -> None:
        self._config, self._channel = config, channel
        self._rectifier = Rectifier(rig)
        camera = self._rectifier.camera
        self.work = Work()
        self.submap = SubmapId(identity.submap)
        self.tiles: dict[tuple[int, int], GridTile] = {}
        self._slam = EkfSlam(camera, config.ekf)
        self._T_c_b = se3.inverse(camera.T_b_c)
        # The body starts level, as its odometer has it; where none is known, the camera does, and looks ahead.
        self._R_l_o = np.eye(3) if rig.has_body else AHEAD
        self._flow = CornerFlow(config.detector, config.ekf)
        self._motion = OdometerMotion(camera.T_b_c, config.ekf, config.odometer.keep_s, config.odometer.max_gap_s)
        self._last: Estimate | None = None
        self._measured_ns: int | None = None  # the last frame whose motion the odometer measured, or the first one
        self._told = False  # that it has measured none since for a while

    def step(self, step_input: StepInput, now_ns: int) -> StepOutput:
        """Take in what arrived, track the frame if there is one. Never waits."""
        self.work.clear()
        self.work.steps = 1
        self._channel.receive(step_input.packets, now_ns)
        self._channel.take_removed()
        self._motion.add(step_input.odometry)
        estimate = predicted = None
        events: list[str] = []
        if step_input.frame is not None:
            estimate, events = self._process(step_input.frame)
        elif step_input.predict_ns is not None:
            predicted = self.predict(step_input.predict_ns)
        return StepOutput(estimate, tuple(self._channel.poll(now_ns)), tuple(events), predicted)

    def predict(self, t_ns: int) -> PredictedPose | None:
        """The pose at a time after the last frame; None too long after it."""
        last = self._last
        dt_s = 0.0 if last is None else (t_ns - last.t_ns) * 1e-9
        if last is None or not 0.0 < dt_s <= self._config.prediction.max_s:
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
        self._flow.add(build_pyramid(left, self._config.detector.levels))
        if self._last is not None:
            self._slam.predict(self._motion.between(self._last.t_ns, frame.t_ns))
        found = self._slam.update(self._flow.ids, self._flow.uv)
        self.work.alignments = 3 * len(self._flow.ids)
        self.work.posed_points = len(found.compatible)
        self._flow.drop(found.rejected)  # flow has slid off them
        events = [f"{len(found.entered)} landmarks entered"] if len(found.entered) else []
        self._last = self._estimate(frame.t_ns, len(found.compatible))
        return self._last, events + self._missing(frame.t_ns)

    def _missing(self, t_ns: int) -> list[str]:
        """An event, once, when the odometer has been silent for a while."""
        if self._motion.measured or self._measured_ns is None:
            self._measured_ns, self._told = t_ns, False
        elif not self._told and t_ns - self._measured_ns >= _SILENT_NS:
            self._told = True
            return ["odometer: no samples arrive; the Kalman filter flies by them"]
        return []

    def _estimate(self, t_ns: int, inliers: int) -> Estimate:
        T_o_b = se3.orthonormalise(self._slam.state.T_o_c @ self._T_c_b)
        cov = self._slam.state.pose_covariance(self._T_c_b)
        limits = self._config.covariance
        by_images = inliers >= self._config.pose.min_inliers
        tracked = by_images or self._motion.measured or self._last is None
        quality = max(1, round(100.0 * probability_good(cov, limits.good_m, limits.good_rad))) if tracked else -1
        return Estimate(
            t_ns, tracked, tracked and not by_images, T_o_b if tracked else None, T_o_b, NO_KEYFRAME, np.eye(4),
            self.submap, inliers, quality, cov, cov, self._R_l_o, None,
        )  # fmt: skip

    # what is known

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
            "time_offset": None, "imu_calibration": None,
            "odometer": {"scale": round(self._slam.state.scale, 4)} if self._motion.measured else None,
        }  # fmt: skip

"""The stages of one agent, wired to each other, and where its flight stands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.covariance.pose_covariance import Certainty
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.governor.governor import Governor
from kiteline_agent.inertial.gravity_alignment import Levelling
from kiteline_agent.initialisation.two_view_start import TwoViewStart
from kiteline_agent.keyframes.keyframe_maker import KeyframeMaker
from kiteline_agent.keyframes.reference import ReferenceKeyframe
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.motion.motion_model import Inertia
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_agent.relocalisation.relocaliser import Relocaliser
from kiteline_agent.step import Identity
from kiteline_agent.submaps.submaps import Submaps
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_agent.tracking.stuck_camera import StuckCamera
from kiteline_agent.tracking.tracker import Tracker
from kiteline_codec.channel import RecordChannel
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraRig, Rectifier
from kiteline_core.ids import SubmapId
from kiteline_core.places.place_index import Vocabulary

F64 = NDArray[np.float64]


class Stages:
    """What tracking and the growth of the map share. T_c_b: (4,4) body in the camera.

    config: at the effort on which the governor decided. frame: number of the last one. last_t_ns: its stamp, once it
    was processed. predicted: T_m_c (4,4) of it. T_o_first: (4,4) of the first submap, as the camera left it last.
    failures: tries since the old map was lost that had texture in view. events: of this step. mono: how one eye begins;
    None with more than that.
    """

    def __init__(
        self,
        rig: CameraRig,
        imu: ImuCalibration | None,
        config: AgentConfig,
        identity: Identity,
        channel: RecordChannel,
        words: Vocabulary | None,
    ) -> None:
        self.config = config
        self.channel = channel
        self.rectifier = Rectifier(rig)
        self.camera = camera = self.rectifier.camera
        self.T_c_b = se3.inverse(camera.T_b_c)
        one_eye = rig.right is None and not rig.has_depth
        self.work = Work()  # of the last step
        self.pose = PoseState()
        self.inertia = Inertia(camera, imu, config.inertial, config.odometer, self.pose, metric=not one_eye)
        self.levelling = Levelling(
            camera, self.inertia.tracker, config.inertial.askew_rad, config.inertial.level_patience_s
        )
        self.map = LocalMap(camera, config.local_map, config.depth_filter)
        self.tracker = Tracker(self.map, config, self.work)
        self.maker = KeyframeMaker(self.map, camera, config, channel, self.work)
        self.reference = ReferenceKeyframe(self.map, camera, self.maker)
        self.submaps = Submaps(identity, self.map, self.pose, self.reference, self.maker)
        self.certainty = Certainty(
            self.map, camera.T_b_c, config.certainty, has_body=rig.has_body, has_depth=not one_eye
        )
        self.governor = Governor(config.governor, inertial=imu is not None)
        self.mono = TwoViewStart(camera, config) if one_eye else None
        self.window = MapCache(camera, config.window, config.matching, config.ransac, words)
        self.base = Corrections(self.map, self.window, config.smoothing)
        self.recovery = Relocaliser(self.map, self.tracker, config, words, self.window, self._believes_found)
        self.frozen = StuckCamera(camera)
        self.events: list[str] = []
        self.frame = 0
        self.last_t_ns: int | None = None
        self.predicted: F64 = np.eye(4)
        self.T_o_first: F64 = np.eye(4)
        self.failures = 0

    def believes(self, T_c_m: F64, submap: SubmapId) -> bool:
        """Whether the camera, tracked at T_c_m (4,4) in a submap, can be there, by what else is known of its way."""
        return self._believes(T_c_m, submap, found=False)

    def _believes_found(self, T_c_m: F64, submap: SubmapId) -> bool:
        return self._believes(T_c_m, submap, found=True)

    def _believes(self, T_c_m: F64, submap: SubmapId, *, found: bool) -> bool:
        return self.certainty.believes(
            T_c_m, submap, self.predicted, self.pose, self.T_c_b, self.submaps.active, found=found
        )  # fmt: skip

    def carry_certainty(self) -> None:
        """What is known of the pose so far is of a map that is left now."""
        if self.submaps.active == self.submaps.first:
            self.T_o_first = self.pose.T_o_m
        self.certainty.carry(self.pose, self.T_c_b, self.submaps.active)

    def knows_place(self) -> bool:
        """Whether it is known by more than odometry how the submap lies to the flight's first; always, of one eye's
        maps: each has its own unit.
        """
        active = self.submaps.active
        return self.mono is not None or active == self.submaps.first or self.base.has_placed(active)

    def move_map(self, T_m_c: F64) -> None:
        """The camera is at T_m_c (4,4) in the submap, and moved in no other frame."""
        before = self.pose.T_m_c
        self.pose.move_map(T_m_c)
        self.inertia.shift(se3.orthonormalise(self.pose.T_m_c @ se3.inverse(before)))
        self.reference.refresh(self.pose.T_m_c)

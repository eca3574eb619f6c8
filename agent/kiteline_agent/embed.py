"""An agent for use as a library: it runs without a base, a log or a flight controller."""

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Identity
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry.cameras import CameraRig
from kiteline_core.ids import AgentId
from kiteline_core.places.place_index import Vocabulary


def standalone_agent(
    rig: CameraRig,
    imu: ImuCalibration | None = None,
    config: AgentConfig | None = None,
    vocabulary: Vocabulary | None = None,
) -> Agent:
    """An agent without a base; call its `step(StepInput(frame, imu_batch), now_ns)` for each frame.

    imu: calibration of the IMU whose samples are passed to `step`, None without one. vocabulary: for relocalisation
    after a loss (`kiteline_hw.system.vocabulary`); without it only the last keyframe is recognised.
    """
    return Agent(rig, imu, config or AgentConfig(), Identity(AgentId(0), boot=0), NoBaseChannel(), vocabulary)

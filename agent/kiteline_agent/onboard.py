"""Builds the onboard half that a configuration asks for."""

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.ekf.ekf_agent import EkfAgent
from kiteline_agent.step import Identity
from kiteline_codec.channel import RecordChannel
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry.cameras import CameraRig
from kiteline_core.places.place_index import Vocabulary

OnboardAgent = Agent | EkfAgent


def onboard_agent(
    rig: CameraRig, imu: ImuCalibration | None, config: AgentConfig, identity: Identity, channel: RecordChannel,
    vocabulary: Vocabulary | None,
) -> OnboardAgent:  # fmt: skip
    """The agent with the tracker of the configuration."""
    if config.tracker == "ekf":
        return EkfAgent(rig, config, identity, channel)
    return Agent(rig, imu, config, identity, channel, vocabulary)

"""`quality` for a flight controller after a loss: it comes back when the map says that odometry is where it was."""

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_core.frame import Frame
from kiteline_core.ids import AgentId
from tests.agent.room_flight import RoomFlight

BEGIN = 50  # the first dark frame, at 20 Hz, without an IMU


def fly(flight: RoomFlight, dark: int) -> tuple[Agent, list[Estimate]]:
    agent = Agent(flight.rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    out = []
    for k, frame in enumerate(flight.frames):
        if BEGIN <= k < BEGIN + dark:
            frame = Frame(frame.t_ns, np.full_like(frame.left, 8), np.full_like(frame.left, 8))
        estimate = agent.step(StepInput(frame), frame.t_ns).estimate
        assert estimate is not None
        out.append(estimate)
    return agent, out


@pytest.mark.parametrize("dark", [12, 14])  # after 16 the map is hardly in view: a last bit decides
def test_quality_comes_back_as_the_map_says(room_flight: RoomFlight, dark: int) -> None:
    agent, found = fly(room_flight.first(5.0), dark)
    before, last = found[BEGIN - 1], found[-1]
    assert agent.odometry_quality(before) > 80
    assert last.tracked and not last.bridged and last.submap == before.submap
    off_m = float(np.linalg.norm(last.T_o_b[:3, 3] - last.T_m_b[:3, 3]))
    quality, sigma_m = agent.odometry_quality(last), float(np.sqrt(np.trace(last.cov_o[:3, :3])))
    assert off_m <= sigma_m < off_m + 0.1  # what the map measured is what the covariance holds
    assert (quality >= 50) == (off_m < 0.3)
    lost = [agent.odometry_quality(e) for e in found if not e.tracked]
    assert lost and max(lost) < 80

"""A right camera that was bent since its calibration: the flight begins with the first frame all the same."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Identity, StepInput
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from tests.agent.room_flight import RoomFlight


@pytest.mark.parametrize("degrees", [0.6, -1.2])  # 2.4 and 4.8 rows at half the usual size
def test_a_rig_whose_rows_are_off_by_pixels_flies_from_the_first_frame(room_flight: RoomFlight, degrees: float) -> None:
    flight = room_flight.first(1.0)
    T_c_r = flight.rig.T_c_r
    assert T_c_r is not None
    bent = se3.from_rt(se3.so3_exp(np.radians([degrees, 0.0, 0.0])), np.zeros(3))
    rig = replace(flight.rig, T_c_r=T_c_r @ bent)
    agent = Agent(rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    outputs = [agent.step(StepInput(frame, None), frame.t_ns) for frame in flight.frames]
    poses = [output.estimate for output in outputs]
    assert all(pose is not None and pose.tracked for pose in poses)
    assert any("rows of the right image are" in event for event in outputs[0].events)
    camera = np.array([pose.T_o_b for pose in poses if pose is not None]) @ rig.T_b_c
    truth = flight.truth @ rig.T_b_c
    aligned = truth[0] @ se3.inverse(camera[0]) @ camera
    assert np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.03


def test_a_right_image_that_shows_something_else_opens_no_map(room_flight: RoomFlight) -> None:
    flight = room_flight.first(1.0)
    agent = Agent(flight.rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    for frame, other in zip(flight.frames, flight.frames[::-1], strict=True):
        assert other.right is not None
        upside_down = np.ascontiguousarray(other.right[::-1, ::-1])
        output = agent.step(StepInput(replace(frame, right=upside_down), None), frame.t_ns)
        assert output.estimate is not None
        assert not output.estimate.tracked
        assert not output.events

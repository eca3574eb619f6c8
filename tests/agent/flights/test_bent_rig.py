"""A right camera that was bent since its calibration begins with the first frame; other pairs are named."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.keyframes.pair_search import Fault
from kiteline_agent.step import Identity, StepInput
from kiteline_core.arrays import U8
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from tests.agent.room_flight import RoomFlight


@pytest.mark.parametrize("degrees", [0.6, -1.2])  # 2.4 and 4.8 rows at half the usual size
def test_a_rig_whose_rows_are_off_by_pixels_flies_from_the_first_frame(room_flight: RoomFlight, degrees: float) -> None:
    flight = room_flight.first(3.0)
    T_c_r = flight.rig.T_c_r
    assert T_c_r is not None
    bent = se3.from_rt(se3.so3_exp(np.radians([degrees, 0.0, 0.0])), np.zeros(3))
    rig = replace(flight.rig, T_c_r=T_c_r @ bent)
    agent = Agent(rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    outputs = [agent.step(StepInput(frame, None), frame.t_ns) for frame in flight.frames]
    poses = [output.estimate for output in outputs]
    assert all(pose is not None and pose.tracked for pose in poses)
    assert any("images: rows of the right image are" in event for event in outputs[0].events)
    camera = np.array([pose.T_o_b for pose in poses if pose is not None]) @ rig.T_b_c
    truth = flight.truth @ rig.T_b_c
    aligned = truth[0] @ se3.inverse(camera[0]) @ camera
    assert np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.08


def test_a_right_camera_that_is_bent_in_flight_is_read_at_its_new_rows(room_flight: RoomFlight) -> None:
    flight, rows, bent_at = room_flight.first(3.0), 4, 20
    agent = Agent(flight.rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    poses, said = [], list[int]()
    for number, frame in enumerate(flight.frames):
        assert frame.right is not None
        right = frame.right if number < bent_at else np.roll(frame.right, rows, axis=0)
        output = agent.step(StepInput(replace(frame, right=right), None), frame.t_ns)
        assert output.estimate is not None
        poses.append(output.estimate.T_o_b)
        said += [number for event in output.events if event.startswith("images: rows of the right image are +4")]
    assert len(said) == 1
    assert bent_at < said[0] < bent_at + 20, "at the next keyframe, before the map has left the view"
    camera, truth = np.array(poses) @ flight.rig.T_b_c, flight.truth @ flight.rig.T_b_c
    aligned = truth[0] @ se3.inverse(camera[0]) @ camera
    assert np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.05


def _upside_down(image: U8) -> U8:
    return np.ascontiguousarray(image[::-1, ::-1])


@pytest.mark.parametrize(("images", "fault"), [
    (lambda left, right: (right, left), Fault.PAIR),
    (lambda left, right: (left, _upside_down(right)), Fault.PAIR),
    (lambda left, right: (left // 64, right // 64), Fault.CORNERS),
])  # fmt: skip
def test_a_pair_with_which_no_map_begins_is_named(
    room_flight: RoomFlight, images: Callable[[U8, U8], tuple[U8, U8]], fault: Fault
) -> None:
    flight = room_flight.first(1.5)
    agent = Agent(flight.rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    said = []
    for frame in flight.frames:
        assert frame.right is not None
        left, right = images(frame.left, frame.right)
        output = agent.step(StepInput(replace(frame, left=left, right=right), None), frame.t_ns)
        assert output.estimate is not None
        assert not output.estimate.tracked
        said += output.events
    assert said == [fault.value]

"""A flight with a leg and text in view: both are left out and named; a flight without them does not change."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.imaging.fixed_parts import CELL_PX
from kiteline_agent.step import Identity, StepInput
from kiteline_core.arrays import F64, U8
from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.ids import AgentId
from tests.agent.room_flight import RoomFlight

Flown = tuple[Agent, list[F64], list[str]]

# Strokes of KITE 7 in pixels: each version of OpenCV has its own fonts.
LETTERS = [
    np.array(stroke, np.int32) + [250, 20]
    for stroke in (
        [(2, 0), (2, 20)], [(14, 0), (2, 12)], [(6, 8), (14, 20)], [(22, 0), (22, 20)], [(30, 0), (46, 0)],
        [(38, 0), (38, 20)], [(66, 0), (54, 0), (54, 20), (66, 20)], [(54, 10), (64, 10)],
        [(90, 0), (104, 0), (94, 20)],
    )
]  # fmt: skip


def drawn(image: U8, shift_px: int) -> U8:
    """A leg at the lower left, elsewhere in the right image, and text at the upper right, alike in both."""
    out, h = image.copy(), len(image)
    corners = np.array([[70 - shift_px, h], [90 - shift_px, h - 80], [112 - shift_px, h - 80], [110 - shift_px, h]])
    cv2.fillPoly(out, [corners.astype(np.int32)], 20)
    for grey, thick in ((0, 5), (255, 2)):
        cv2.polylines(out, LETTERS, False, grey, thick)
    return out


def with_parts(frame: Frame) -> Frame:
    assert frame.right is not None
    return replace(frame, left=drawn(frame.left, 0), right=drawn(frame.right, 40))


def fly(flight: RoomFlight, frames: list[Frame], config: AgentConfig | None = None) -> Flown:
    agent = Agent(flight.rig, flight.imu, config or AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    poses, events, begin_ns, s = list[F64](), list[str](), 0, flight.samples
    for frame in frames:
        felt = (s.t_ns > begin_ns) & (s.t_ns <= frame.t_ns)
        begin_ns = frame.t_ns
        out = agent.step(StepInput(frame, ImuBatch(s.t_ns[felt], s.gyro[felt], s.accel[felt])), frame.t_ns)
        assert out.estimate is not None
        poses.append(out.estimate.T_o_b)
        events += [event for event in out.events if event.startswith("images:")]
    return agent, poses, events


@pytest.fixture(scope="module")
def flown(room_flight: RoomFlight) -> Flown:
    return fly(room_flight, [with_parts(frame) for frame in room_flight.frames])


def test_parts_in_view_are_named_where_they_are(room_flight: RoomFlight, flown: Flown) -> None:
    agent, _, events = flown
    assert len(events) >= 1 and "set covered = [" in events[0] and "[agent.detector]" in events[0]
    named = np.reshape(agent.motion_reports()["fixed_parts"], (-1, 4))
    h, w = room_flight.frames[0].left.shape
    leg, text = np.array([90 / w, 1.0 - 40 / h]), np.array([300 / w, 35 / h])
    for point in (leg, text):
        assert any((part[:2] <= point).all() and (point <= part[2:]).all() for part in named)
    assert ((named[:, 2] - named[:, 0]) * (named[:, 3] - named[:, 1])).sum() < 0.25


def test_their_landmarks_are_dropped_and_no_new_ones_made(flown: Flown) -> None:
    agent = flown[0]
    covered = np.reshape(agent._config.detector.covered, (-1, 4)) * np.tile(
        [agent.map.camera.width, agent.map.camera.height], 2
    )
    uv = agent.map.uv[agent.map.usable]
    inside = [((uv >= part[:2] + 1.0) & (uv <= part[2:] - 1.0)).all(axis=1).sum() for part in covered]
    assert len(covered) and sum(inside) == 0
    assert (covered[:, 2:] - covered[:, :2]).min() > CELL_PX - 2.0 or covered[:, 3].max() > 0.9


def test_such_a_flight_repeats_to_the_last_bit(room_flight: RoomFlight, flown: Flown) -> None:
    _, poses, events = fly(room_flight, [with_parts(frame) for frame in room_flight.frames])
    assert events == flown[2] and all((a == b).all() for a, b in zip(poses, flown[1], strict=True))


def test_a_flight_without_such_parts_is_the_same_without_the_search(room_flight: RoomFlight) -> None:
    config = AgentConfig()
    agent, poses, events = fly(room_flight, room_flight.frames)
    _, plain, _ = fly(
        room_flight, room_flight.frames, replace(config, fixed_parts=replace(config.fixed_parts, on=False))
    )
    assert not events and agent.motion_reports()["fixed_parts"] == []
    assert all((a == b).all() for a, b in zip(poses, plain, strict=True))

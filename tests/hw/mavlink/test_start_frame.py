"""The frame of the poses sent: at the start, north, or where it was before a restart."""

from __future__ import annotations

import json
from dataclasses import replace
from math import cos, degrees, pi, radians, sin
from pathlib import Path

import numpy as np
import pytest

from kiteline_core.geometry import se3
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_session import ControllerSession
from kiteline_hw.mavlink.coordinate_frames import euler_angles, mounting
from kiteline_hw.mavlink.messages import Attitude, Heartbeat, LocalPosition, MavlinkMessage, Odometry
from kiteline_hw.mavlink.pose_memory import PoseMemory
from kiteline_hw.mavlink.start_frame import LastPose, StartConfig, StartFrame, heading_of
from kiteline_hw.ports import PoseSample

S = 1_000_000_000
LETTERS = ("flu", "frd", "rdf", "urf", "bru", "lbu")


def level_start(axes: str) -> np.ndarray:
    """R_o_b as the agent begins: z up with the least rotation of the body, so that the heading is any."""
    up = mounting(axes)[:3, :3] @ [0.0, 0.0, -1.0]
    axis = np.cross(up, [0.0, 0.0, 1.0])
    s, c = float(np.linalg.norm(axis)), float(up[2])
    if s < 1e-9:
        return np.eye(3) if c > 0 else np.diag([1.0, -1.0, -1.0])
    return se3.so3_exp(axis / s * np.arctan2(s, c))


class Flight:
    """An agent's session with a controller that turns by itself, and what it sends."""

    def __init__(self, axes: str = "flu", *, last: LastPose | None = None, north: bool = False) -> None:
        self.T_b_f = mounting(axes)
        self.start = StartFrame(self.T_b_f, StartConfig(north=north), last)
        self.session = ControllerSession(self.T_b_f, start=self.start)
        self.R_o_b = level_start(axes)
        self.wire = MavlinkCodec(1, 1)
        self.requested: list[bytes] = []

    def hear(self, message: MavlinkMessage, now_ns: int) -> None:
        self.requested += self.session.receive(self.wire.encode(message), now_ns)

    def pose(self, t_ns: int, forward_m: float = 0.0) -> Odometry | None:
        T_f = se3.from_rt(np.eye(3), np.array([forward_m, 0.0, 0.0]))  # along the nose
        T_o_f0 = se3.from_rt(self.R_o_b, np.zeros(3)) @ self.T_b_f
        T_o_b = T_o_f0 @ T_f @ se3.inverse(self.T_b_f)
        found = self.session._pose_message(
            PoseSample(t_ns, T_o_b, True, 90, velocity=np.zeros(3), rate=np.zeros(3)), t_ns
        )
        assert found is None or isinstance(found, Odometry)
        return found


def yaw_of(m: Odometry | None) -> float:
    assert m is not None
    roll, pitch, yaw = euler_angles(m.q)
    assert abs(roll) < 1e-6 and abs(pitch) < 1e-6
    return yaw


@pytest.mark.parametrize("axes", LETTERS)
def test_a_flight_begins_with_heading_zero_however_the_body_is_mounted(axes: str) -> None:
    flight = Flight(axes)
    flight.hear(Heartbeat(2, 3), 0)
    m = flight.pose(S, forward_m=2.0)
    assert yaw_of(m) == pytest.approx(0.0, abs=1e-9)
    assert m is not None
    np.testing.assert_allclose(m.position_m, [2.0, 0.0, 0.0], atol=1e-9)  # forward is x
    assert flight.requested == []  # a disarmed controller without a flight before is asked for nothing


def test_without_a_controller_the_first_pose_waits_for_a_heartbeat_but_not_for_long() -> None:
    flight = Flight()
    assert flight.pose(0) is None and flight.pose(S) is None
    assert flight.session.counters.held == 2 and flight.start.holds
    assert yaw_of(flight.pose(2 * S)) == pytest.approx(0.0)
    assert not flight.start.holds


@pytest.mark.parametrize("axes", LETTERS)
def test_a_restart_in_flight_goes_on_where_the_controller_believes_itself_to_be(axes: str) -> None:
    flight = Flight(axes, last=LastPose((9.0, 9.0, -9.0), 2.5, armed=True))
    flight.hear(Heartbeat(2, 3, armed=True), 0)
    assert len(flight.requested) == 2  # ATTITUDE and LOCAL_POSITION_NED
    assert flight.pose(S // 10) is None  # it holds back until the heading is known
    yaw, rate = radians(130.0), 0.4
    flight.hear(LocalPosition(0, (4.0, -3.0, -2.0), (1.0, 0.0, 0.0)), 2 * S)
    flight.hear(Attitude(0, (0.0, 0.0, yaw), (0.0, 0.0, rate)), 2 * S)
    m = flight.pose(2 * S + S // 10)
    assert yaw_of(m) == pytest.approx(yaw + 0.04)  # it kept turning since
    assert m is not None
    np.testing.assert_allclose(m.position_m, [4.1, -3.0, -2.0], atol=1e-9)
    later = flight.pose(3 * S, forward_m=1.0)
    assert later is not None
    ahead = np.array([cos(yaw + 0.04), sin(yaw + 0.04), 0.0])
    np.testing.assert_allclose(later.position_m, [4.1, -3.0, -2.0] + ahead, atol=1e-9)


def test_an_armed_controller_is_in_flight_even_if_nothing_is_remembered() -> None:
    flight = Flight()
    flight.hear(Heartbeat(2, 3, armed=True), 0)
    assert flight.pose(0) is None and flight.pose(20 * S) is None  # better no pose than a swing
    flight.hear(Attitude(0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)), 21 * S)
    assert yaw_of(flight.pose(21 * S)) == pytest.approx(1.0)


def test_a_silent_controller_is_replaced_by_the_last_pose() -> None:
    flight = Flight(last=LastPose((4.0, -3.0, -2.0), 1.25, armed=True))
    assert flight.pose(0) is None and flight.pose(4 * S) is None
    m = flight.pose(5 * S)
    assert yaw_of(m) == pytest.approx(1.25)
    assert m is not None
    np.testing.assert_allclose(m.position_m, [4.0, -3.0, -2.0], atol=1e-9)


def test_an_old_attitude_does_not_count() -> None:
    flight = Flight(last=LastPose((0.0, 0.0, 0.0), 0.5, armed=True))
    flight.hear(Heartbeat(2, 3, armed=True), 0)
    flight.hear(Attitude(0, (0.0, 0.0, 2.0), (0.0, 0.0, 0.0)), 0)
    assert flight.pose(S) is None


def test_north_is_the_controllers() -> None:
    flight = Flight(north=True)
    flight.hear(Heartbeat(2, 12), 0)
    assert flight.pose(30 * S) is None  # never without it
    flight.hear(Attitude(0, (0.1, -0.1, -2.0), (0.0, 0.0, 0.0)), 30 * S)
    flight.hear(LocalPosition(0, (50.0, 60.0, -7.0), (0.0, 0.0, 0.0)), 30 * S)
    m = flight.pose(30 * S)
    assert yaw_of(m) == pytest.approx(-2.0)
    assert m is not None
    np.testing.assert_allclose(m.position_m, 0.0, atol=1e-9)  # a flight begins at the origin


def test_a_restart_disturbs_a_controller_that_takes_its_yaw_from_poses_by_less_than_three_degrees() -> None:
    """A filter whose yaw is pulled to the poses' at 15 degrees/s, as EKF3 does, and holds it while none come."""
    yaw, truth, worst = radians(70.0), radians(70.0), 0.0
    last: LastPose | None = None
    for life in range(2):
        flight = Flight("urf", last=last)
        if life == 0:
            flight.start._T_s_o = np.eye(4)
            flight.R_o_b = flight.R_o_b  # any heading will do: the filter begins with it
            yaw = truth = yaw_of(flight.pose(0))
        for i in range(1, 200):
            now_ns = life * 20 * S + i * S // 20
            if i % 20 == 1:
                flight.hear(Heartbeat(2, 3, armed=True), now_ns)
            if flight.requested:
                flight.hear(Attitude(0, (0.0, 0.0, yaw), (0.0, 0.0, 0.0)), now_ns)
            m = flight.pose(now_ns)
            if m is not None:
                error = (yaw_of(m) - yaw + pi) % (2 * pi) - pi
                yaw += max(-radians(15.0) / 20, min(radians(15.0) / 20, error))
            worst = max(worst, abs((yaw - truth + pi) % (2 * pi) - pi))
        last = flight.session.last_pose()
    assert degrees(worst) < 3.0


@pytest.mark.parametrize("axes", LETTERS)
def test_heading_of_a_nose_that_points_up(axes: str) -> None:
    level = se3.so3_exp(np.array([0.0, 0.0, -0.7])) @ np.diag([1.0, -1.0, -1.0])
    assert heading_of(level) == pytest.approx(0.7)
    assert heading_of(level @ se3.so3_exp(np.array([0.0, radians(85.0), 0.0]))) == pytest.approx(0.7)


def test_the_memory_outlives_a_process_but_not_a_boot(tmp_path: Path) -> None:
    last, path = LastPose((1.0, 2.0, -3.0), 0.5, armed=True), tmp_path / "agent0" / "last_pose.json"
    memory = PoseMemory(path)
    assert memory.load(0) is None
    memory.save(last, 10 * S)
    memory.save(replace(last, heading_rad=9.0), 10 * S + 1)  # too early for another write
    assert PoseMemory(path).load(20 * S) == last
    assert PoseMemory(path).load(90 * S) is None  # a minute later the flight is over
    assert PoseMemory(path).load(9 * S) is None  # another clock
    stored = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**stored, "boot": "another"}), encoding="utf-8")
    assert PoseMemory(path).load(20 * S) is None
    for garbage in ("", "{}", "[1]", '{"position_m": [1]}', "null"):
        path.write_text(garbage, encoding="utf-8")
        assert PoseMemory(path).load(20 * S) is None

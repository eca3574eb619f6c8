"""The frame of the poses sent: at the start, north, or where it was before a restart."""

import json
from collections.abc import Callable
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
from kiteline_hw.mavlink.watch.controller_watch import ControllerWatch
from kiteline_hw.ports import PoseSample
from kiteline_hw.sim.autopilot import ModelledAutopilot

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
    roll, pitch, yaw = euler_angles(m.q)
    assert abs(roll) < 1e-6 and abs(pitch) < 1e-6
    return yaw


@pytest.mark.parametrize("axes", LETTERS)
def test_a_flight_begins_with_heading_zero_however_the_body_is_mounted(axes: str) -> None:
    flight = Flight(axes)
    flight.hear(Heartbeat(2, 3), 0)
    m = flight.pose(S, forward_m=2.0)
    assert yaw_of(m) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(m.position_m, [2.0, 0.0, 0.0], atol=1e-9)  # forward is x
    assert flight.requested == []  # a disarmed controller without a flight before is asked for nothing


def test_without_a_controller_the_first_pose_waits_for_a_heartbeat_but_not_for_long() -> None:
    flight = Flight()
    assert flight.pose(0) is None and flight.pose(S) is None
    assert flight.session.counters.held == 2
    assert yaw_of(flight.pose(2 * S)) == pytest.approx(0.0)
    assert flight.start.known


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
    np.testing.assert_allclose(m.position_m, [4.1, -3.0, -2.0], atol=1e-9)
    later = flight.pose(3 * S, forward_m=1.0)
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
    np.testing.assert_allclose(m.position_m, [4.0, -3.0, -2.0], atol=1e-9)


def test_held_poses_are_said() -> None:
    T_b_f, model = mounting("flu"), MavlinkCodec(1, 1)
    watch = ControllerWatch(T_b_f)
    session = ControllerSession(T_b_f, start=StartFrame(T_b_f), watch=watch)
    for i in range(60):
        now_ns = i * S // 10
        session.receive(model.encode(Heartbeat(2, 3, armed=True)), now_ns)
        session.step(PoseSample(now_ns, np.eye(4), True, 90), now_ns)
        session.watch(now_ns)
    session.receive(model.encode(Attitude(0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))), 6 * S)
    for i in range(60, 70):
        session.step(PoseSample(i * S // 10, np.eye(4), True, 90), i * S // 10)
        session.watch(i * S // 10)
    found = [f.text for f in watch.take() if f.topic == "heading"]
    assert len(found) == 2 and "held back" in found[0] and "known" in found[1]


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
    np.testing.assert_allclose(m.position_m, 0.0, atol=1e-9)  # a flight begins at the origin


def restarted(*, goes_on: bool) -> tuple[float, float]:
    """Degrees by which the yaw of a hovering controller is disturbed when the agent restarts, and metres."""
    model = ModelledAutopilot("ardupilot", armed=True, turns_with_poses=True, angles_rad=(0.0, 0.0, 2.0))
    T_b_f, last, worst_rad, worst_m = mounting("urf"), None, 0.0, 0.0
    hover = se3.from_rt(level_start("urf"), np.array([0.0, 0.0, 1.0]))
    first: tuple[float, float, float] | None = None
    for life in range(2):
        # the odometry frame of each life is another one
        T_o_b = hover if life == 0 else se3.exp(np.array([3.0, 1.0, 0.0, 0.0, 0.0, 1.1])) @ hover
        start = StartFrame(T_b_f, last=last) if goes_on else None
        session = ControllerSession(T_b_f, start=start)
        for i in range(400):
            now_ns = life * 22 * S + i * S // 20
            for data in session.step(PoseSample(now_ns, T_o_b, True, 90), now_ns):
                for answer in model.receive(data, now_ns):
                    session.receive(answer, now_ns)
            for data in model.poll(now_ns):
                for answer in session.receive(data, now_ns):
                    model.receive(answer, now_ns)
            if life == 0 and i == 399:
                yaw, first = model.angles_rad[2], model.position_m
            elif life == 1:
                assert first is not None
                worst_rad = max(worst_rad, abs((model.angles_rad[2] - yaw + pi) % (2 * pi) - pi))
                worst_m = max(worst_m, float(np.linalg.norm(np.subtract(model.position_m, first))))
        last = session.last_pose()
        assert session.counters.odometry > 300
    return degrees(worst_rad), worst_m


def test_a_restart_disturbs_a_controller_that_takes_its_yaw_from_poses_by_less_than_three_degrees() -> None:
    turned, moved_m = restarted(goes_on=True)
    assert turned < 0.1 and moved_m < 0.01
    turned, moved_m = restarted(goes_on=False)
    assert turned > 20.0 and moved_m > 1.0  # the model is one that suffers


@pytest.mark.parametrize("axes", LETTERS)
def test_heading_of_a_nose_that_points_up(axes: str) -> None:
    level = se3.so3_exp(np.array([0.0, 0.0, -0.7])) @ np.diag([1.0, -1.0, -1.0])
    assert heading_of(level) == pytest.approx(0.7)
    assert heading_of(level @ se3.so3_exp(np.array([0.0, radians(85.0), 0.0]))) == pytest.approx(0.7)


def test_the_memory_outlives_a_process_but_not_a_boot(tmp_path: Path) -> None:
    last, path = LastPose((1.0, 2.0, -3.0), 0.5, armed=True), tmp_path / "agent0" / "last_pose.json"
    memory = PoseMemory(path, beside=lambda write: write())
    assert memory.load(0) is None
    memory.save(last, 10 * S)
    memory.save(replace(last, heading_rad=9.0), 10 * S + 1)  # too early for another write
    assert PoseMemory(path).load(20 * S) == last
    assert PoseMemory(path).load(90 * S) is None  # a minute later the flight is over
    assert PoseMemory(path).load(9 * S) is None  # another clock
    stored = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**stored, "boot": "another"}), encoding="utf-8")
    assert PoseMemory(path).load(20 * S) is None
    path.write_text(json.dumps({k: v for k, v in stored.items() if k != "boot"}), encoding="utf-8")
    assert PoseMemory(path).load(20 * S) is None
    for garbage in ("", "{}", "[1]", '{"position_m": [1]}', "null"):
        path.write_text(garbage, encoding="utf-8")
        assert PoseMemory(path).load(20 * S) is None


def test_a_disk_that_stalls_holds_up_no_messages(tmp_path: Path) -> None:
    waiting: list[Callable[[], None]] = []
    memory = PoseMemory(tmp_path / "last_pose.json", beside=waiting.append)
    for second in range(10):
        memory.save(LastPose((float(second), 0.0, 0.0), 0.0, armed=True), second * S)
    assert len(waiting) == 1  # two writes would share a file
    waiting.pop()()
    memory.save(LastPose((10.0, 0.0, 0.0), 0.0, armed=True), 10 * S)
    waiting.pop()()
    found = memory.load(10 * S)
    assert found is not None and found.position_m[0] == 10.0

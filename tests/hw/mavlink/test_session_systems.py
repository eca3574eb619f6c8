"""Which vehicle is served, origins and the older messages; frames as they are on the wire."""

from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.controller_odometry import ControllerOdometry, OdometrySource
from kiteline_hw.mavlink.controller_session import ControllerSession, SessionConfig
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.messages import (
    Attitude,
    ComputerStatus,
    GlobalOrigin,
    Heartbeat,
    LocalPosition,
    TimeSync,
    VehicleImu,
)
from kiteline_hw.ports import PoseSample, SourceReport

S, FLU = 1_000_000_000, mounting("flu")


def read(frames: list[bytes]) -> list[Any]:
    """The messages of frames by pymavlink alone."""
    parser = common.MAVLink(None)
    return [message for frame in frames for message in parser.parse_buffer(frame) or []]


def test_the_vehicle_is_learnt_and_others_are_not_mixed_in() -> None:
    imu = ControllerImu(np.eye(3), 200.0, SourceReport())
    odometry = ControllerOdometry(OdometrySource.CONTROLLER, FLU)
    session = ControllerSession(FLU, imu=imu, odometry=odometry)
    ours, other = MavlinkCodec(7, 1), MavlinkCodec(1, 1)
    still = VehicleImu(1, (0.0, 0.0, -9.8), (0.0, 0.0, 0.0))
    session.receive(other.encode(still), 0)  # before any heartbeat
    requests = read(session.receive(ours.encode(Heartbeat(2, 3)), 0))
    assert requests
    for m in requests:
        assert m.get_type() == "COMMAND_LONG" and m.target_system == 7 and m.get_srcSystem() == 7
    for i in range(1, 6):
        now_ns = i * 5_000_000
        assert session.receive(other.encode(Heartbeat(2, 12)), now_ns) == []
        assert session.receive(other.encode(TimeSync(0, 5)), now_ns) == []
        session.receive(other.encode(VehicleImu(9_000_000 + i, (5.0, 5.0, 5.0), (1.0, 1.0, 1.0))), now_ns)
        session.receive(other.encode(Attitude(i, (0.0, 0.0, 2.0), (0.0, 0.0, 0.0))), now_ns)
        session.receive(other.encode(LocalPosition(i, (0.0, 0.0, 0.0), (9.0, 0.0, 0.0))), now_ns)
        session.receive(ours.encode(VehicleImu(i * 5000, (0.0, 0.0, -9.8), (0.0, 0.0, 0.0))), now_ns)
    batch = session.take_imu(S)
    assert len(batch.t_ns) == 5 and (batch.accel[:, 2] < -9.7).all()
    assert session.take_odometry(S) is None
    assert session.counters.other_autopilots == 5 and session.codec.other_systems == 21
    found = session.autopilot(S)
    assert found.system == 7


def test_a_system_that_was_told_is_the_only_one() -> None:
    session = ControllerSession(FLU, system=4)
    session.receive(MavlinkCodec(1, 1).encode(Heartbeat(2, 3)), 0)
    assert session.autopilot(0) is None
    session.receive(MavlinkCodec(4, 1).encode(Heartbeat(2, 3)), 0)
    assert session.autopilot(0) is not None
    assert read(session.step(None, S))[0].get_srcSystem() == 4


def test_an_origin_is_set_while_disarmed_until_the_controller_has_one() -> None:
    session = ControllerSession(FLU, SessionConfig(origin=GlobalOrigin(473_566_100, 85_190_300, 408_000)))
    wire = MavlinkCodec(2, 1)
    assert session.receive(wire.encode(Heartbeat(2, 3, armed=True)), 0) == []
    sent = [len(session.receive(wire.encode(Heartbeat(2, 3)), i * S)) for i in range(1, 8)]
    assert sent == [1, 0, 0, 0, 0, 1, 0]
    m = read(session.receive(wire.encode(Heartbeat(2, 3)), 20 * S))[0]
    assert (m.target_system, m.latitude, m.longitude, m.altitude) == (2, 473_566_100, 85_190_300, 408_000)
    session.receive(wire.encode(GlobalOrigin(1, 2, 3)), 21 * S)  # it has one
    assert session.receive(wire.encode(Heartbeat(2, 3)), 40 * S) == []


def test_the_older_messages_say_the_same_as_odometry() -> None:
    pose = PoseSample(S, np.eye(4), True, 80, velocity=np.array([1.0, 2.0, 0.5]), rate=np.zeros(3))
    pose.T_o_b[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # the nose to the left
    pose.T_o_b[:3, 3] = [3.0, 4.0, 1.0]
    session = ControllerSession(FLU, SessionConfig(vision=True))
    _, position, speed = read(session.step(pose, 0))
    assert position.get_type() == "VISION_POSITION_ESTIMATE" and speed.get_type() == "VISION_SPEED_ESTIMATE"
    assert [position.x, position.y, position.z] == [3.0, -4.0, -1.0]
    np.testing.assert_allclose([position.roll, position.pitch, position.yaw], [0.0, 0.0, -np.pi / 2], atol=1e-6)
    np.testing.assert_allclose([speed.x, speed.y, speed.z], [1.0, -2.0, -0.5], atol=1e-6)
    assert position.usec == speed.usec == S // 1000
    lost = PoseSample(2 * S, np.eye(4), False, -1, velocity=np.zeros(3), rate=np.zeros(3))
    assert [m.get_type() for m in read(session.step(lost, 2 * S))] == ["HEARTBEAT"]


@pytest.mark.parametrize(
    ("message", "frame"),
    [
        (Heartbeat(), "fd09000000 01c5 000000 00000000120800 0403"),
        (GlobalOrigin(473_566_100, 85_190_300, 408_000), "fd0b000000 01c5 310000 940b3a1c 9ce61305 c03906"),
    ],
)
def test_golden_frames(message: Heartbeat | GlobalOrigin, frame: str) -> None:
    """As the definitions of MAVLink lay them out, without the checksum."""
    assert MavlinkCodec().encode(message)[:-2].hex() == frame.replace(" ", "")


def test_the_computers_state() -> None:
    m = read([MavlinkCodec().encode(ComputerStatus(5, 6, (10, 30), 512, None, 61))])[0]
    assert m.get_type() == "ONBOARD_COMPUTER_STATUS"
    assert m.cpu_cores == [10, 30, *[255] * 6] and m.cpu_combined[0] == 20
    assert (m.ram_usage, m.ram_total, m.temperature_core[0]) == (512, 2**32 - 1, 61)
    empty = read([MavlinkCodec().encode(ComputerStatus(5, 6, (), None, None, None))])[0]
    assert empty.cpu_combined == [255] * 10 and empty.temperature_core == [127] * 8

"""Whole flights of an agent on the IMU of a flight controller, whose samples come late and with another clock."""

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.controller_imu_config import ControllerImuConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.messages import VehicleImu
from kiteline_hw.ports import SourceReport
from tests.agent.room_flight import RoomFlight

BOOT_NS = 400_000_000_000  # our clock at the controller's zero
DARK = range(60, 75)


@pytest.fixture(scope="module")
def flight(room_flight: RoomFlight) -> RoomFlight:
    """4 s in full motion through a room, at half the usual size."""
    return room_flight.first(4.0)


def fly(flight: RoomFlight, latency_ns: int, jitter_ns: int) -> list[Estimate]:
    """EuRoC's body (x up, y right, z forward) holds a controller that speaks FRD."""
    felt = flight.samples
    late = latency_ns + np.random.default_rng(3).integers(0, jitter_ns + 1, len(felt.t_ns))
    arrives = np.maximum.accumulate(felt.t_ns + late)
    R_b_f = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    imu = ControllerImu(R_b_f, 200.0, SourceReport())
    noise = ControllerImuConfig().noise
    agent = Agent(flight.rig, noise, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    out, done = [], 0
    for k, frame in enumerate(flight.frames):
        now_ns = frame.t_ns + 2_000_000  # the camera is quicker than the controller
        while done < len(arrives) and arrives[done] <= now_ns:
            g, a = felt.gyro[done], felt.accel[done]
            sample = VehicleImu(
                int(felt.t_ns[done] + BOOT_NS) // 1000, (a[2], a[1], -a[0]), (g[2], g[1], -g[0])
            )  # forward, right, down
            imu.receive(sample, None, int(arrives[done]))
            done += 1
        if k in DARK:
            frame = Frame(frame.t_ns, np.full_like(frame.left, 8), np.full_like(frame.left, 8))
        output = agent.step(StepInput(frame, imu.take_until(frame.t_ns)), frame.t_ns)
        assert output.estimate is not None
        out.append(output.estimate)
    assert done > 700
    return out


@pytest.mark.parametrize(("latency_ms", "jitter_ms"), [(0, 0), (12, 10), (30, 15)])
def test_samples_that_come_late_carry_the_pose_all_the_same(
    flight: RoomFlight, latency_ms: int, jitter_ms: int
) -> None:
    found = fly(flight, latency_ms * 1_000_000, jitter_ms * 1_000_000)

    def off_m(begin: int, end: int) -> float:
        flown = se3.inverse(found[begin].T_o_b) @ found[end].T_o_b
        true = se3.inverse(flight.truth[begin]) @ flight.truth[end]
        return float(np.linalg.norm(flown[:3, 3] - true[:3, 3]))

    assert all(e.tracked for e in found)
    assert all(found[k].bridged for k in DARK)
    assert off_m(5, DARK.start - 1) < 0.03
    assert off_m(DARK.start - 1, DARK.stop - 1) < 0.05  # 0.75 s without images
    level = found[59].R_l_o
    up = level @ found[59].T_o_b[:3, :3] @ flight.truth[59, :3, :3].T @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=0.05)

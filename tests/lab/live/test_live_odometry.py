"""A live flight with odometry of a flight controller that has a clock of its own, and the same flight from its log."""

import threading
import time
from pathlib import Path

import pytest

from kiteline_agent.runtime.live import fly_live
from kiteline_agent.runtime.options import AgentOptions
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.mavlink.messages import WheelDistance
from kiteline_hw.ports import LinkError
from kiteline_hw.sim.flight_controller import FlightController, UdpFlightController
from kiteline_hw.system import process
from kiteline_lab.replay.replay import replay_agent

SPEED_M_S, OFFSET_NS = 0.4, 7_000_000_000  # of the wall's recording: 2 cm a frame to the camera's right


def test_wheels_of_a_flight_controller_reach_the_agent(recording: Path, tmp_path: Path) -> None:
    model, over = FlightController("ardupilot"), threading.Event()
    with UdpFlightController(model, clock_offset_ns=OFFSET_NS) as controller:

        def roll() -> None:
            while not over.wait(0.02):
                t_ns = time.monotonic_ns()
                rolled = SPEED_M_S * t_ns * 1e-9
                with controller.lock:
                    controller.send(model.codec.encode(WheelDistance((t_ns + OFFSET_NS) // 1000, (rolled,) * 2)))

        wheels = threading.Thread(target=roll)
        wheels.start()
        try:
            spec = AgentOptions(
                source=str(recording), folder=str(tmp_path), mavlink=f"udp:127.0.0.1:{controller.port}",
                odometry="wheels", axes="frd",
            )  # fmt: skip
            fly_live(spec, None, process.StopSignal())
        finally:
            over.set()
            wheels.join()
    with LogReader(tmp_path / "log.mcap") as log:
        batches = [message.odometry() for message in log.messages(["/odometer"])]
        frames = [message.t_ns for message in log.messages(["/left/image"])]
        assert sum(len(batch.t_ns) for batch in batches) > 10
        for batch in batches:
            assert batch.velocity[:, 0] == pytest.approx(SPEED_M_S, abs=0.05)
            assert batch.velocity[:, 1] == pytest.approx(0.0, abs=1e-6)
            assert frames[0] - 500_000_000 < batch.t_ns[0] <= batch.t_ns[-1] <= frames[-1]
        assert replay_agent(log).difference is None


def test_odometry_needs_a_flight_controller(recording: Path, tmp_path: Path) -> None:
    spec = AgentOptions(source=str(recording), folder=str(tmp_path), odometry="wheels")
    with pytest.raises(LinkError, match="expected --mavlink URL"):
        fly_live(spec, None, process.StopSignal())
    spec = AgentOptions(source=str(recording), folder=str(tmp_path), odometry="feet", mavlink="udp:127.0.0.1:14550")
    with pytest.raises(LinkError, match="expected controller, wheels or wheels:TRACK_M"):
        fly_live(spec, None, process.StopSignal())

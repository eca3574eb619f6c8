"""A live flight on the IMU of a flight controller that has a clock of its own, and the same flight from its log."""

import threading
import time
from math import cos, radians, sin
from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.runtime.flight_log import estimate_from_json
from kiteline_agent.runtime.live import fly_live
from kiteline_agent.runtime.options import AgentOptions, options_of, parser
from kiteline_core.config import ConfigError
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.mavlink.connect import ControllerOptions, connect
from kiteline_hw.ports import LinkError, SourceReport
from kiteline_hw.sim.flight_controller import FlightController, UdpFlightController
from kiteline_hw.system import process
from kiteline_hw.system.clock import MonotonicClock
from kiteline_lab.replay.replay import replay_agent

OFFSET_NS = 7_000_000_000  # the controller's clock ahead of ours
DOWN, UP = (0.0, 0.0, -9.81), 2  # what a level controller feels; the axis of height

# The wall's camera slides to its right at constant speed. Mounted so that it looks 20 degrees down: its right is the
# vehicle's right, its down points back and down, its forward points ahead and down.
S, C = sin(radians(20.0)), cos(radians(20.0))
TILTED = f"T_f_c = [0, {-S}, {C}, 0.1,  1, 0, 0, 0,  0, {C}, {S}, 0,  0, 0, 0, 1]"


def fly(recording: Path, folder: Path) -> None:
    config = folder / "agent.toml"
    config.write_text(f"[agent.controller_imu]\n{TILTED}\n", encoding="utf-8")
    model, over = FlightController("px4"), threading.Event()
    with UdpFlightController(model, clock_offset_ns=OFFSET_NS) as controller:

        def feel() -> None:
            while not over.wait(0.005):
                t_us = (time.monotonic_ns() + OFFSET_NS) // 1000
                with controller.lock:
                    controller.send(model.imu(t_us, DOWN, (0.0, 0.0, 0.0)))

        unit = threading.Thread(target=feel)
        unit.start()
        try:
            url = f"udp:127.0.0.1:{controller.port}"
            a = parser().parse_args([str(recording), "--mavlink", url, "--imu", "controller", "--config", str(config),
                                     "--log", str(folder)])  # fmt: skip
            fly_live(options_of(a, folder), None, process.StopSignal())
        finally:
            over.set()
            unit.join()


def test_the_imu_of_a_flight_controller_reaches_the_agent(recording: Path, tmp_path: Path) -> None:
    fly(recording, tmp_path)
    with LogReader(tmp_path / "boot.mcap") as log:
        batches = [message.imu() for message in log.messages(["/imu"])]
        frames = [message.t_ns for message in log.messages(["/left/image"])]
        assert sum(len(batch.t_ns) for batch in batches) > 50
        for batch in batches:
            assert batch.accel == pytest.approx(np.tile(DOWN, (len(batch.t_ns), 1)), abs=1e-5)
            assert frames[0] - 500_000_000 < batch.t_ns[0] <= batch.t_ns[-1] <= frames[-1]
        last = estimate_from_json([message.json() for message in log.messages(["/estimate"])][-1])
        # the body is the controller's, which stands upright: its down is down, although the camera looks 20 degrees off
        R_l_b = last.R_l_o @ last.T_o_b[:3, :3]
        assert R_l_b[:, UP] == pytest.approx([0.0, 0.0, -1.0], abs=0.05)
        # poses are predicted between the frames, and a replay makes the same ones
        predicted = [message.json() for message in log.messages(["/predicted"])]
        assert len(predicted) > 10
        assert {p["source"] for p in predicted} <= {"imu", "velocity"}
        assert replay_agent(log).difference is None


def test_a_source_that_knows_its_body_needs_letters_only() -> None:
    rig = CameraRig(CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5), None, np.eye(4), None)
    model, clock, batch = FlightController("px4"), MonotonicClock(), None
    with UdpFlightController(model) as controller:
        url = f"udp:127.0.0.1:{controller.port}"
        with connect(ControllerOptions(url, "urf"), rig, clock, imu_rate_hz=200.0, report=SourceReport()) as sink:
            end_s = time.monotonic() + 5.0
            while batch is None and time.monotonic() < end_s:
                with controller.lock:
                    controller.send(model.imu(time.monotonic_ns() // 1000, (1.0, 2.0, -9.5), (0.25, 0.5, 0.125)))
                time.sleep(0.02)
                batch = sink.take_imu(clock.now_ns())
    assert batch.accel[0] == pytest.approx([9.5, 2.0, 1.0])  # up, right, forward
    assert batch.gyro[0] == pytest.approx([-0.125, 0.5, 0.25])


def test_what_is_missing_is_said(recording: Path, tmp_path: Path) -> None:
    def refused(error: type[Exception], match: str, **options: object) -> None:
        spec = AgentOptions(source=str(recording), folder=str(tmp_path), imu_of="controller", **options)  # type: ignore[arg-type]
        with pytest.raises(error, match=match):
            fly_live(spec, None, process.StopSignal())

    url, config = "udp:127.0.0.1:14550", tmp_path / "agent.toml"
    refused(LinkError, "expected --mavlink URL")
    refused(LinkError, "--no-imu", mavlink=url, imu=False)
    refused(LinkError, "expected T_f_c", mavlink=url)
    refused(LinkError, "expected T_f_c", mavlink=url, axes="rdf")  # the recording knows no body
    config.write_text("[agent.controller_imu]\nT_f_c = [1, 0, 0]\n", encoding="utf-8")
    refused(ConfigError, "no rigid motion", mavlink=url, config=str(config))
    mirrored = "-1, 0, 0, 0,  0, 1, 0, 0,  0, 0, 1, 0,  0, 0, 0, 1"
    config.write_text(f"[agent.controller_imu]\nT_f_c = [{mirrored}]\n", encoding="utf-8")
    refused(ConfigError, "no rigid motion", mavlink=url, config=str(config))
    config.write_text(f"[agent.controller_imu]\n{TILTED}\n", encoding="utf-8")
    refused(LinkError, "the body is the controller's", mavlink=url, config=str(config), axes="rdf")

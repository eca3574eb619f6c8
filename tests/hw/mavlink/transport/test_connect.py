"""Connections to a flight controller, and devices that are missing."""

import os
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.mavlink.connect import ControllerOptions, connect
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.messages import Heartbeat
from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink
from kiteline_hw.ports import LinkError, PoseSample, SourceReport
from kiteline_hw.sim.autopilot import ModelledAutopilot
from kiteline_hw.system.clock import MonotonicClock
from tests.hw.mavlink.transport.test_signing import signed
from tests.hw.processes import free_port

RIG, CLOCK = CameraRig(CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5), None, np.eye(4), None), MonotonicClock()


def test_offset_and_key_reach_the_wire(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_text(bytes(range(32)).hex(), encoding="utf-8")
    with socket.socket(type=socket.SOCK_DGRAM) as controller:
        controller.bind(("127.0.0.1", 0))
        controller.settimeout(5.0)
        options = ControllerOptions(
            f"udp:127.0.0.1:{controller.getsockname()[1]}", "flu", "0.3,0.1,-0.2", messages="vision", key=str(key),
            folder=str(tmp_path / "agent0"),
        )  # fmt: skip
        with connect(options, RIG, CLOCK, report=SourceReport()) as sink:
            _, agent = controller.recvfrom(2048)
            autopilot = signed(tmp_path / "autopilot")
            controller.sendto(autopilot.encode(Heartbeat(2, 3)), agent)
            found: dict[str, common.MAVLink_message] = {}
            for i in range(1, 200):
                t_ns = i * 50_000_000
                sink.push(PoseSample(t_ns, np.eye(4), True, 90, velocity=np.zeros(3), rate=np.zeros(3)), t_ns)
                data = controller.recv(2048)
                assert data[2] & 1  # signed
                for m in common.MAVLink(None).parse_buffer(data) or []:
                    found[m.get_type()] = m
                if "VISION_POSITION_ESTIMATE" in found and "ONBOARD_COMPUTER_STATUS" in found:
                    break
    pose = found["VISION_POSITION_ESTIMATE"]
    assert [pose.x, pose.y, pose.z] == pytest.approx([0.3, -0.1, 0.2])
    assert found["ONBOARD_COMPUTER_STATUS"].ram_total > 0
    assert (tmp_path / "agent0" / "mavlink_stamp").exists()


@pytest.mark.parametrize(
    ("match", "options"),
    [
        ("--offset 1,2: expected X,Y,Z", {"offset": "1,2"}),
        ("--offset 0,nan,0: expected X,Y,Z", {"offset": "0,nan,0"}),
        ("--offset 120,0,30: more than 10 m", {"offset": "120,0,30"}),
        ("--origin 47: expected LAT,LON,ALT", {"origin": "47"}),
        ("--origin 147,8,400: no place on earth", {"origin": "147,8,400"}),
        ("--heading west: expected start or controller", {"heading": "west"}),
        ("--pose-messages mocap: expected odometry or vision", {"messages": "mocap"}),
        ("cannot read the key", {"key": "/nowhere/key"}),
    ],
)
def test_wrong_options_are_named_with_what_is_expected(match: str, options: dict[str, str]) -> None:
    url = f"udp:127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    with pytest.raises(LinkError, match=match):
        connect(ControllerOptions(url, **options), RIG, CLOCK, report=SourceReport())


def test_a_missing_device_and_a_controller_behind_it(tmp_path: Path) -> None:
    clock, model, said = MonotonicClock(), ModelledAutopilot("px4"), list[str]()
    port = tmp_path / "ttyUSB0"
    with MavlinkPoseSink(f"serial:{port}:921600", mounting("flu"), clock, required=False) as sink:

        def serve(fd: int | None, until: str) -> None:
            end_s = time.monotonic() + 8.0
            while until not in "\n".join(said):
                assert time.monotonic() < end_s, said
                now_ns = clock.now_ns()
                sink.push(PoseSample(now_ns, np.eye(4), True, 90), now_ns)
                if fd is not None:
                    try:
                        data = os.read(fd, 4096)
                    except BlockingIOError:
                        data = b""
                    for answer in model.receive(data, now_ns) + model.poll(now_ns):
                        os.write(fd, answer)
                time.sleep(0.005)
                said.extend(f.line for f in sink.take_findings())

        serve(None, "device is missing")
        master, slave = os.openpty()
        os.set_blocking(master, False)
        port.symlink_to(os.ttyname(slave))
        serve(master, "found: PX4 4.6.3, quadrotor, system 1")
        assert any(line.endswith("is open") for line in said)
        port.unlink()
        os.close(slave)
        os.close(master)
        serve(None, "the device is ")
        assert sum("device is missing" in line for line in said) <= 2

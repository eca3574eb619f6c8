"""Our messages read by MAVSDK's server, which shares no code with ours."""

import importlib.util
import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink
from kiteline_hw.ports import PoseSample
from kiteline_hw.sim.flight_controller import FlightController
from kiteline_hw.system.clock import MonotonicClock
from tests.hw.processes import free_port

CLIENT = """
import asyncio, sys
from mavsdk import System

async def main():
    drone = System(mavsdk_server_address="127.0.0.1", port=int(sys.argv[1]))
    await drone.connect()
    for name in ("ODOMETRY", "HEARTBEAT"):
        async for message in drone.mavlink_direct.message(name):
            if message.component_id == 197:
                print(message.fields_json, flush=True)
                break

asyncio.run(asyncio.wait_for(main(), 20))
"""


def test_mavsdk_reads_our_odometry() -> None:
    spec = importlib.util.find_spec("mavsdk")
    server = Path(spec.origin).parent / "bin" / "mavsdk_server" if spec is not None and spec.origin else None
    if server is None or not server.exists():
        pytest.skip("mavsdk<4 with its mavsdk_server is not installed")
    rpc, udp = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM)
    quiet = subprocess.DEVNULL
    clock, model = MonotonicClock(), FlightController("px4")
    # Nose to the left, 1 m forward, 2 m left, 3 m up of the start.
    t_o_b = np.array([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
    server_process = subprocess.Popen(
        [str(server), "-p", str(rpc), f"udpin://127.0.0.1:{udp}"], stdout=quiet, stderr=quiet
    )
    client = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", CLIENT, str(rpc)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as controller,
            MavlinkPoseSink(f"udp:127.0.0.1:{udp}", mounting("flu"), clock) as sink,
        ):
            end_s = time.monotonic() + 20.0
            while client.poll() is None and time.monotonic() < end_s:
                now_ns = clock.now_ns()
                for message in model.poll(now_ns):
                    controller.sendto(message, ("127.0.0.1", udp))
                sink.push(PoseSample(now_ns, t_o_b, True, 77, 5), now_ns)
                time.sleep(0.02)
        out, err = client.communicate(timeout=5)
        assert client.returncode == 0, err
    finally:
        client.kill()
        server_process.kill()
        client.communicate()
        server_process.wait()
    odometry, heartbeat = map(json.loads, out.splitlines())
    assert (odometry["x"], odometry["y"], odometry["z"]) == (1, -2, -3)
    np.testing.assert_allclose(odometry["q"], [0.70710678, 0.0, 0.0, -0.70710678], atol=1e-5)
    assert (odometry["frame_id"], odometry["child_frame_id"], odometry["estimator_type"]) == (20, 12, 3)
    assert (odometry["quality"], odometry["reset_counter"]) == (77, 5)
    assert odometry["time_usec"] == pytest.approx(clock.now_ns() / 1000, abs=30e6)
    for i in (0, 6, 11, 15, 18, 20):
        assert odometry["pose_covariance"][i] > 0.0
    assert (heartbeat["type"], heartbeat["autopilot"]) == (18, 8)

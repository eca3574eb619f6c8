"""What a pose sink says over a real pseudo terminal: its device missing, there, and gone again."""

import os
import time
from pathlib import Path

import numpy as np

from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink
from kiteline_hw.ports import PoseSample
from kiteline_hw.sim.autopilot import ModelledAutopilot
from kiteline_hw.system.clock import MonotonicClock


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

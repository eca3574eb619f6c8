"""What a controller's IMU costs the agent's process: MAVLink at 200 Hz over a socket, beside a recording's."""

import contextlib
import socket
import subprocess
import sys
import time

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, environment
from kiteline_core.arrays import F64
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.messages import Heartbeat, VehicleImu
from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink
from kiteline_hw.ports import SourceReport
from kiteline_hw.sensors.imu_buffer import ImuTable
from kiteline_hw.system.clock import MonotonicClock

_RATE_HZ, _FPS = 200.0, 20.0
_SPAN_S, _ROUNDS = 5.0, 3  # s of each measurement; with samples and without them, in turn


def run(bench: Bench) -> list[Bar]:
    """CPU time with samples over MAVLink, less that with the samples of a recording; the median of the rounds."""
    bench.say("inertial samples over MAVLink")
    more_ms = [_cpu_ms(_RATE_HZ) - _cpu_ms(0.0) for _ in range(_ROUNDS)]
    name = f"inertial samples at {_RATE_HZ:g} Hz over MAVLink: CPU a frame more than of a recording"
    return [at_most(name, float(np.median(more_ms)), 0.5, "ms", 2)]


def _cpu_ms(rate_hz: float) -> float:
    """CPU time in ms a frame of this process, which holds the sink; another process sends.

    rate_hz: of the samples that it sends; 0: heartbeats alone, and as many samples come from a table.
    """
    T_b_f: F64 = mounting("urf")
    imu = ControllerImu(np.ascontiguousarray(T_b_f[:3, :3]), _RATE_HZ, SourceReport())
    times_ns = time.monotonic_ns() + np.arange(round(100.0 * _RATE_HZ)) * round(1e9 / _RATE_HZ)
    recorded = ImuTable(times_ns, np.zeros((len(times_ns), 3)), np.full((len(times_ns), 3), 9.8), SourceReport())
    with contextlib.ExitStack() as stack:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = int(free.getsockname()[1])
        sink = stack.enter_context(MavlinkPoseSink(f"udpin:127.0.0.1:{port}", T_b_f, MonotonicClock(), imu=imu))
        sender = subprocess.Popen([sys.executable, "-m", __name__, str(port), str(rate_hz)], env=environment())
        stack.callback(sender.wait)
        stack.callback(sender.kill)
        while sink.autopilot() is None:
            time.sleep(0.05)
        time.sleep(0.5)
        begin_ns, frames, taken = time.process_time_ns(), round(_SPAN_S * _FPS), 0
        for _ in range(frames):
            time.sleep(1.0 / _FPS)
            now_ns = time.monotonic_ns()
            batch = sink.take_imu(now_ns) if rate_hz else recorded.take_until(now_ns)
            taken += 0 if batch is None else len(batch.t_ns)
        spent_ms = (time.process_time_ns() - begin_ns) * 1e-6
    if taken < 0.8 * _RATE_HZ * _SPAN_S:
        return float("inf")  # the samples did not come
    return spent_ms / frames


def _send(port: int, rate_hz: float) -> None:
    """A flight controller's heartbeats and samples, until it is killed."""
    codec, out = MavlinkCodec(1, 1), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    tick_s = 1.0 / (rate_hz or 2.0)
    begin_s, k = time.monotonic(), 0
    while True:
        if k % max(1, round(0.5 / tick_s)) == 0:
            out.sendto(codec.encode(Heartbeat(2, 3)), ("127.0.0.1", port))
        if rate_hz:
            sample = VehicleImu(round(k * tick_s * 1e6), (0.1, 0.2, -9.8), (0.001 * (k % 100), 0.0, 0.0))
            out.sendto(codec.encode(sample), ("127.0.0.1", port))
        k += 1
        time.sleep(max(0.0, begin_s + k * tick_s - time.monotonic()))


if __name__ == "__main__":
    _send(int(sys.argv[1]), float(sys.argv[2]))

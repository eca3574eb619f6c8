"""A modelled pair of cameras at 20 Hz beside a base, a flight controller and a log, on one core that others load."""

import contextlib
import os
import signal
import socket
import subprocess
import time

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.vehicle.agent_process import command, favour, start
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import Heartbeat, Odometry

_FLIGHT_S = 20.0
_WARM_S = 3.0  # s after the first pose that do not count
_LOAD = 0.6  # of the core, by another process
_LATENCY_MS = 50.0
_BURN = f"""
import time
while True:
    end = time.monotonic() + {0.1 * _LOAD}
    while time.monotonic() < end: pass
    time.sleep({0.1 * (1.0 - _LOAD)})
"""


def run(bench: Bench) -> list[Bar]:
    """Fly for half a minute, alone on the core and beside the load."""
    return [bar for load in (False, True) for bar in _fly(bench, load)]


def _fly(bench: Bench, load: bool) -> list[Bar]:
    name = f"beside {_LOAD:.0%} load of its core" if load else "core to itself"
    bench.say(f"live camera, {name}")
    folder = bench.folder / f"live-camera-{int(load)}"
    folder.mkdir(parents=True, exist_ok=True)
    core = {max(os.sched_getaffinity(0))}
    (folder / "agent.toml").write_text("[agent.prediction]\nrate_hz = 0.0\n")  # poses of the frames themselves
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        listener.bind(("127.0.0.1", 0))
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            link = f"zenoh:tcp/127.0.0.1:{free.getsockname()[1]}"
        start(stack, ["-m", "kiteline_cli", "base", "--link", link], folder / "base.txt", prefer=False)
        if load:
            start(stack, ["-c", _BURN], folder / "load.txt", core)
        options = ["--link", link, "--log", str(folder), "--config", str(folder / "agent.toml"),
                   "--mavlink", f"udp:127.0.0.1:{listener.getsockname()[1]}"]  # fmt: skip
        agent = start(stack, command(bench.source("room_flight.mcap"), "", options), folder / "agent.txt", core)
        before = os.getpriority(os.PRIO_PROCESS, 0)
        favour(os.getpid())  # the listener must not wait for the machine either
        latencies_ms = _listen(listener, agent)
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, before)
        agent.send_signal(signal.SIGTERM)
        agent.wait(10.0)
    over = [line for line in (folder / "agent.txt").read_text().splitlines() if line.startswith("over: ")]
    dropped = int(over[0].split(" lost, ")[1].split(" dropped")[0]) if over else -1
    p95 = float(np.percentile(latencies_ms, 95)) if latencies_ms else float("inf")
    return [
        is_true(f"{name}: no dropped frame", "0", dropped == 0, f"{dropped} of {over[0].split()[1] if over else '?'}"),
        at_most(f"{name}: capture to ODOMETRY, p95", p95, _LATENCY_MS, "ms", 1),
    ]


def _listen(listener: socket.socket, agent: subprocess.Popen[bytes]) -> list[float]:
    """Capture to arrival of each ODOMETRY in ms: both are on this machine's monotonic clock."""
    listener.settimeout(0.2)
    codec, out = MavlinkCodec(1, 1), list[float]()
    begin_s, first_s, beat_s = time.monotonic(), None, 0.0
    while time.monotonic() - (first_s or begin_s + 120.0) < _FLIGHT_S and agent.poll() is None:
        try:
            data, peer = listener.recvfrom(2048)
        except TimeoutError:
            continue
        now_ns = time.monotonic_ns()
        if now_ns / 1e9 - beat_s > 0.5:
            beat_s = now_ns / 1e9
            listener.sendto(codec.encode(Heartbeat(2, 3)), peer)
        for message in codec.receive(data, datagram=True):
            if isinstance(message, Odometry):
                first_s = first_s or time.monotonic()
                if time.monotonic() - first_s > _WARM_S:
                    out.append(now_ns / 1e6 - message.time_usec / 1e3)
    return out

"""A modelled pair of cameras at 20 Hz beside a base, a flight controller and a log, on one core that others load."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_core.frame import Frame
from kiteline_hw.cameras import v4l2
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import Heartbeat, Odometry
from kiteline_hw.sim.sensors.video_device import ModelDevice, ModelKernel
from kiteline_hw.sources.open import open_source

TITLE = "A live camera: modelled devices at 20 Hz beside link, MAVLink and log"

_FPS = 20.0
_SHOWN = 200  # frames of the recording that the cameras show, to and fro
_FLIGHT_S = 20.0
_WARM_S = 3.0  # s after the first pose that do not count
_LOAD = 0.6  # of the core, by another process
_LATENCY_MS = 50.0
_NICE = -10  # as in systemd/kiteline-agent.service, for the load too: what else this machine does counts little
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
        _start(stack, ["-m", "kiteline_cli", "base", "--link", link], folder / "base.txt", None)
        if load:
            _start(stack, ["-c", _BURN], folder / "load.txt", core)
        agent = _start(
            stack,
            ["-m", __name__, str(bench.data / "room_flight.mcap"), "--link", link, "--log", str(folder),
             "--config", str(folder / "agent.toml"), "--mavlink", f"udp:127.0.0.1:{listener.getsockname()[1]}"],
            folder / "agent.txt", core,
        )  # fmt: skip
        before = os.getpriority(os.PRIO_PROCESS, 0)
        _prefer(0)  # the listener must not wait for the machine either
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


def _start(
    stack: contextlib.ExitStack, arguments: list[str], text: Path, cores: set[int] | None
) -> subprocess.Popen[bytes]:
    out = stack.enter_context(text.open("wb"))
    child = subprocess.Popen([sys.executable, *arguments], stdout=out, stderr=out)
    if cores:
        os.sched_setaffinity(child.pid, cores)
        _prefer(child.pid)

    def end() -> None:
        child.kill()
        child.wait()

    stack.callback(end)
    return child


def _prefer(pid: int) -> None:
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, pid, _NICE)


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


def _agent(recording: str, options: list[str]) -> int:
    """The agent's process, with modelled devices in place of real ones."""
    from kiteline_agent.__main__ import main

    frames: list[Frame] = []
    for item in open_source(recording):
        if isinstance(item, Frame):
            frames.append(item)
        if len(frames) == _SHOWN:
            break
    height, width = frames[0].left.shape
    around = [*frames, *frames[-2:0:-1]]
    images = [[np.asarray(side).tobytes() for side in (f.left, f.right)] for f in around[:_SHOWN]]

    def of(side: int, k: int) -> bytes:
        turn = k % len(around)
        return images[min(turn, len(around) - turn)][side]

    left = ModelDevice(lambda k: of(0, k), {"GREY": [(width, height)]}, _FPS)
    right = ModelDevice(lambda k: of(1, k), {"GREY": [(width, height)]}, _FPS)
    left.begin_ns = right.begin_ns = time.monotonic_ns()
    v4l2.KERNEL = ModelKernel({"/dev/video0": left, "/dev/video2": right})
    return main([f"v4l2:/dev/video0,/dev/video2?fps={_FPS:g}&calibration={recording}", *options])


if __name__ == "__main__":
    raise SystemExit(_agent(sys.argv[1], sys.argv[2:]))

"""Flights that need a process of their own: under the kernel's CPU limit, over half an hour, from a cold start.

`python -m kiteline_bench.harness.processes TRIAL SOURCE` flies one of them and prints the outcome as JSON;
`far-end` is the other side of a link, in a process of its own so that its memory is not counted.
"""

import argparse
import contextlib
import json
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import cv2

from kiteline_agent.runtime.warm import warm
from kiteline_agent.step import StepInput
from kiteline_bench.harness.bars import environment, run_command
from kiteline_bench.harness.limited_cpu import fly_limited
from kiteline_bench.harness.recording import Recording, items_of, load
from kiteline_bench.harness.run import FlyingAgent
from kiteline_codec.channel import coded_channel
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.cpu import CpuQuota
from kiteline_hw.system.memory import release_memory, rss_mib

_TIMEOUT_S = 900.0
_MODULE = "kiteline_bench.harness.processes"


def start(trial: str, source: str, *options: str) -> dict[str, Any]:
    """Run a trial in a process of its own and return its outcome. Raises RuntimeError with the end of its stderr."""
    done = run_command([sys.executable, "-m", _MODULE, trial, source, *options], _TIMEOUT_S)
    if done.returncode:
        raise RuntimeError(f"{trial} {source}: {done.stderr[-300:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main(argv: list[str] | None = None) -> int:
    """Run one trial: quota (the kernel's limit), soak (memory over minutes), first-pose (its time) or far-end."""
    p = argparse.ArgumentParser(description="Flights that need a process of their own.")
    p.add_argument("trial", choices=("quota", "soak", "first-pose", "far-end"))
    p.add_argument("source")
    p.add_argument("--percent", type=float, default=0.0)
    p.add_argument("--governor", action="store_true")
    p.add_argument("--no-imu", action="store_true")
    p.add_argument("--link", action="store_true", help="the link is up")
    p.add_argument("--frames", type=int, default=0)
    p.add_argument("--begin", type=int, default=0, help="first frame")
    p.add_argument("--minutes", type=float, default=30.0)
    a = p.parse_args(argv)
    cv2.setNumThreads(1)
    if a.trial == "far-end":
        return _far_end(sys.stdin.buffer, sys.stdout.buffer)
    if a.trial == "first-pose":
        print(json.dumps({"seconds": _first_pose_s(a.source)}))
        return 0
    recording = load(a.source, imu=not a.no_imu, frames=a.begin + a.frames if a.frames else None).part(a.begin)
    warm()
    release_memory()
    with contextlib.ExitStack() as stack:
        if a.trial == "soak":
            far = stack.enter_context(_far()) if a.link else None
            found = soak(recording.between_rests() if recording.imu is not None else recording, a.minutes, far)
            print(json.dumps(found))
            return 0
        if a.percent > 0.0:
            stack.enter_context(CpuQuota(a.percent)).add(os.getpid())
        print(json.dumps(asdict(fly_limited(recording, a.percent, governor=a.governor, real=True))))
    return 0


# soak


Exchange = Callable[[Sequence[bytes], int], list[bytes]]


def soak(recording: Recording, minutes: float, far: Exchange | None) -> dict[str, Any]:
    """Fly to and fro. rss_mib: at the end of each minute. lost: frames without a pose. far: the other end of the link.

    Steps the agent without a record of the flight, whose memory would be counted.
    """
    found: list[float] = []
    per_minute = round(60e9 / recording.period_ns)
    lost, packets = 0, list[bytes]()
    with tempfile.TemporaryDirectory(prefix="kiteline-soak-") as folder:
        channel = coded_channel(1, spill=SpillFile(Path(folder)), bounded=True)
        agent = FlyingAgent(recording.rig, recording.imu, channel=channel, vocabulary=False).box
        for k, item in enumerate(recording.to_and_fro(round(minutes * per_minute)), 1):
            output = agent.step(StepInput(item.frame, item.imu, tuple(packets)), item.frame.t_ns)
            lost += output.estimate is None or not output.estimate.tracked
            packets = far(output.packets, item.frame.t_ns) if far is not None else []
            if k % per_minute == 0:
                found.append(rss_mib())
    return {"rss_mib": found, "lost": lost}


_COUNT, _HEAD = struct.Struct("<qH"), struct.Struct("<I")  # time and number of packets; bytes of one


@contextlib.contextmanager
def _far() -> Iterator[Exchange]:
    command = [sys.executable, "-m", _MODULE, "far-end", ""]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment()) as process:
        assert process.stdin is not None and process.stdout is not None
        to, back = process.stdin, process.stdout

        def exchange(packets: Sequence[bytes], now_ns: int) -> list[bytes]:
            _write(to, packets, now_ns)
            answer = _read(back)
            return [] if answer is None else answer[0]

        yield exchange
        to.close()


def _far_end(source: BinaryIO, to: BinaryIO) -> int:
    """Receive packets and answer at once, until the other side closes."""
    channel = coded_channel(1)
    while (received := _read(source)) is not None:
        packets, now_ns = received
        channel.receive(packets, now_ns)
        _write(to, channel.poll(now_ns), now_ns)
    return 0


def _write(to: Any, packets: Sequence[bytes], now_ns: int) -> None:
    to.write(_COUNT.pack(now_ns, len(packets)) + b"".join(_HEAD.pack(len(p)) + p for p in packets))
    to.flush()


def _read(source: Any) -> tuple[list[bytes], int] | None:
    head = source.read(_COUNT.size)
    if len(head) < _COUNT.size:
        return None
    now_ns, n = _COUNT.unpack(head)
    return [source.read(_HEAD.unpack(source.read(_HEAD.size))[0]) for _ in range(n)], now_ns


# start


def _first_pose_s(source: str) -> float:
    """Seconds from the start of this process to its first pose."""
    opened = open_source(source)
    warm()
    agent = FlyingAgent(opened.rig, opened.imu, vocabulary=False)
    for item in items_of(opened):
        agent.step(item)
        if agent.run.tracked:
            break
    with open("/proc/self/stat") as file:
        started_ticks = int(file.read().rsplit(")", 1)[1].split()[19])
    with open("/proc/uptime") as file:
        uptime_s = float(file.read().split()[0])
    return uptime_s - started_ticks / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    raise SystemExit(main())

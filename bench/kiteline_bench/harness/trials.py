"""Trials of the agent that need a process of their own: under the kernel's CPU limit, over half an hour, at a start.

`python -m kiteline_bench.harness.trials TRIAL SOURCE` flies one of them and prints the outcome as JSON;
`far-end` is the other side of a link in a process of its own, so that its memory is not counted.
"""

from __future__ import annotations

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

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime.warm import warm
from kiteline_agent.step import Identity, StepInput
from kiteline_bench.harness.clip import Clip, load
from kiteline_bench.harness.governed import fly_clip
from kiteline_codec.channel import coded_channel
from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.ids import AgentId
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.cpu import CpuQuota
from kiteline_hw.system.memory import release_memory, rss_mib

_PATIENCE_S = 900.0


def start(trial: str, source: str, *options: str) -> dict[str, Any]:
    """Run a trial in a process of its own and give what it found. Raises RuntimeError with its last words."""
    command = [sys.executable, "-m", "kiteline_bench.harness.trials", trial, source, *options]
    done = subprocess.run(
        command, check=False, env=_environment(), capture_output=True, text=True, timeout=_PATIENCE_S
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{trial} {source}: {done.stderr[-300:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}


def main(argv: list[str] | None = None) -> int:
    """quota: fly under the kernel's limit. soak: memory over minutes. first-pose: its time. far-end: of a link."""
    p = argparse.ArgumentParser(description="Trials of the agent that need a process of their own.")
    p.add_argument("trial", choices=("quota", "soak", "first-pose", "far-end"))
    p.add_argument("source")
    p.add_argument("--percent", type=float, default=0.0)
    p.add_argument("--governor", action="store_true")
    p.add_argument("--no-imu", action="store_true")
    p.add_argument("--link", action="store_true", help="the link is up")
    p.add_argument("--frames", type=int, default=0)
    p.add_argument("--begin", type=int, default=0, help="frames that are left out before them")
    p.add_argument("--minutes", type=float, default=30.0)
    a = p.parse_args(argv)
    cv2.setNumThreads(1)
    if a.trial == "far-end":
        return _far_end(sys.stdin.buffer, sys.stdout.buffer)
    if a.trial == "first-pose":
        print(json.dumps({"seconds": _first_pose_s(a.source)}))
        return 0
    clip = load(a.source, imu=not a.no_imu, frames=a.begin + a.frames if a.frames else 0)
    clip = clip.part(a.begin, len(clip.items))
    warm(clip.rig)
    release_memory()
    with contextlib.ExitStack() as stack:
        if a.trial == "soak":
            far = stack.enter_context(_far()) if a.link else None
            found = soak(clip.calm() if clip.imu is not None else clip, a.minutes, far)
            print(json.dumps(found))
            return 0
        if a.percent > 0.0:
            stack.enter_context(CpuQuota(a.percent)).add(os.getpid())
        print(json.dumps(asdict(fly_clip(clip, a.percent, governor=a.governor, real=True))))
    return 0


# soak


Exchange = Callable[[Sequence[bytes], int], list[bytes]]


def soak(clip: Clip, minutes: float, far: Exchange | None) -> dict[str, Any]:
    """A flight to and fro. rss_mib: at the end of each minute. lost: frames without a pose. far: the other end."""
    found: list[float] = []
    per_minute = round(60e9 / clip.period_ns)
    lost, packets = 0, list[bytes]()
    with tempfile.TemporaryDirectory(prefix="kiteline-soak-") as folder:
        channel = coded_channel(1, spill=SpillFile(Path(folder)), bounded=True)
        agent = Agent(clip.rig, clip.imu, AgentConfig(), Identity(AgentId(0), 0), channel)
        for k, (frame, imu) in enumerate(clip.to_and_fro(round(minutes * per_minute)), 1):
            output = agent.step(StepInput(frame, imu, tuple(packets)), frame.t_ns)
            lost += output.estimate is None or not output.estimate.tracked
            packets = far(output.packets, frame.t_ns) if far is not None else []
            if k % per_minute == 0:
                found.append(rss_mib())
    return {"rss_mib": found, "lost": lost}


_COUNT, _HEAD = struct.Struct("<qH"), struct.Struct("<I")  # time and number of packets; bytes of one


@contextlib.contextmanager
def _far() -> Iterator[Exchange]:
    command = [sys.executable, "-m", "kiteline_bench.harness.trials", "far-end", ""]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=_environment()) as process:
        assert process.stdin is not None and process.stdout is not None
        to, back = process.stdin, process.stdout

        def exchange(packets: Sequence[bytes], now_ns: int) -> list[bytes]:
            _write(to, packets, now_ns)
            answer = _read(back)
            return [] if answer is None else answer[0]

        yield exchange
        to.close()


def _far_end(source: BinaryIO, to: BinaryIO) -> int:
    """Takes in what comes, and answers at once, until the other side closes."""
    channel = coded_channel(1)
    while (heard := _read(source)) is not None:
        packets, now_ns = heard
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
    warm(opened.rig)
    agent = Agent(opened.rig, opened.imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    imu = None
    for item in opened:
        if isinstance(item, ImuBatch):
            imu = item
        if not isinstance(item, Frame):
            continue
        estimate = agent.step(StepInput(item, imu), item.t_ns).estimate
        if estimate is not None and estimate.tracked:
            break
    with open("/proc/self/stat") as file:
        started_ticks = int(file.read().rsplit(")", 1)[1].split()[19])
    with open("/proc/uptime") as file:
        uptime_s = float(file.read().split()[0])
    return uptime_s - started_ticks / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    raise SystemExit(main())

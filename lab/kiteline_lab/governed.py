"""Flights under a CPU limit, modelled or by the kernel, with the governor on or off; and what came of them.

Run as a module it flies one of them under the kernel's limit, or one of the other trials that need a process of their
own (see `main`), and prints what came of it as JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_agent.agent import Agent
from kiteline_agent.alone import AloneChannel
from kiteline_agent.camera import joined
from kiteline_agent.config import AgentConfig
from kiteline_agent.cost import VirtualCpu
from kiteline_agent.cost_model import cost_ns
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_agent.warm import warm
from kiteline_core.frame import Frame, ImuBatch, Trajectory
from kiteline_core.ids import AgentId
from kiteline_hw.cpu import CpuQuota, process_cpu_ns
from kiteline_lab import metrics
from kiteline_lab.clip import Clip, load

I64 = NDArray[np.int64]

_SETTLED_NS = 3_000_000_000  # after the start, from when on the budget has to hold
_WINDOW_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Governed:
    """One flight. percent: of one core, 0 without a limit. load, peak: percent of one core, over the whole flight and
    in the dearest one-second window after 3 s. quality: mean of the tracked frames.
    """

    percent: float
    governor: bool
    real: bool
    frames: int
    tracked: int
    lost: int
    dropped: int
    submaps: int
    load: float
    peak: float
    ate_m: float
    rpe_mm: float
    quality: float


def fly_clip(clip: Clip, percent: float, *, governor: bool, real: bool) -> Governed:
    """Fly a clip on a core of which `percent` are ours. real: paced by the clock, under a limit set elsewhere."""
    config = AgentConfig()
    if governor and percent > 0.0:
        config = replace(config, governor=replace(config.governor, cpu_percent=percent))
    agent = Agent(clip.rig, clip.imu, config, Identity(AgentId(0), 0), AloneChannel())
    estimates: list[Estimate | None] = []
    spent: list[tuple[int, int]] = []
    core = VirtualCpu(percent)
    begin_ns, start_ns = time.monotonic_ns(), clip.items[0][0].t_ns
    told_ns = 0
    held: list[ImuBatch] = []
    for frame, imu in clip.items:
        if imu is not None:
            held.append(imu)
        if real:
            late_ns = time.monotonic_ns() - begin_ns - (frame.t_ns - start_ns)
            if late_ns >= clip.period_ns:  # the newest wins
                estimates.append(None)
                continue
            time.sleep(max(-late_ns, 0) / 1e9)
        elif core.newest_wins(frame.t_ns, clip.period_ns):
            estimates.append(None)
            continue
        cpu_ns = process_cpu_ns()
        output = agent.step(StepInput(frame, joined(held), (), told_ns), frame.t_ns)
        told_ns = process_cpu_ns() - cpu_ns if real else cost_ns(agent.work)
        core.spend(told_ns, frame.t_ns)
        spent.append((frame.t_ns, told_ns))
        estimates.append(output.estimate)
        held = []
    return _judged(clip, percent, governor, real, estimates, np.array(spent, np.int64))


def _judged(
    clip: Clip, percent: float, governor: bool, real: bool, estimates: list[Estimate | None], spent: I64
) -> Governed:
    good = [e for e in estimates if e is not None and e.tracked and e.T_m_b is not None]
    ate_m = rpe_mm = float("nan")
    if clip.truth is not None and len(good) > 3:
        stamps = np.array([e.t_ns for e in good], np.int64)
        found = metrics.evaluate(Trajectory(stamps, np.array([e.T_m_b for e in good])), clip.truth)
        ate_m = found.ate_m.rmse
        rpe_mm = 1000.0 * found.rpe_frame.translation_m.rmse if found.rpe_frame is not None else rpe_mm
    dropped = sum(e is None for e in estimates)
    span_ns = clip.items[-1][0].t_ns - clip.items[0][0].t_ns + clip.period_ns
    return Governed(
        percent, governor, real, len(estimates), len(good), len(estimates) - len(good) - dropped, dropped,
        len({e.submap for e in good}), 100.0 * float(spent[:, 1].sum()) / span_ns, 100.0 * dearest_window(spent),
        ate_m, rpe_mm, float(np.mean([e.quality for e in good])) if good else 0.0,
    )  # fmt: skip


def dearest_window(spent: I64, settled_ns: int = _SETTLED_NS) -> float:
    """The largest share of a core in any one-second window that ends `settled_ns` after the start or later.

    spent: (n,2) time and CPU time in ns, in order of time.
    """
    t_ns, cpu_ns = spent[:, 0], spent[:, 1]
    total = np.concatenate([[0], np.cumsum(cpu_ns)])
    first = np.searchsorted(t_ns, t_ns - _WINDOW_NS, side="right")
    sums = total[1:] - total[first]
    return float(sums[t_ns >= t_ns[0] + settled_ns].max(initial=0)) / _WINDOW_NS


def rss_over_time(clip: Clip, minutes: float, agent: Agent, rss_mib: Callable[[], float]) -> list[float]:
    """Resident memory in MiB at the end of each minute of a flight to and fro."""
    found: list[float] = []
    per_minute = round(60e9 / clip.period_ns)
    for k, frame in enumerate(clip.to_and_fro(round(minutes * per_minute)), 1):
        agent.step(StepInput(frame), frame.t_ns)
        if k % per_minute == 0:
            found.append(rss_mib())
    return found


def main(argv: list[str] | None = None) -> int:
    """quota: fly under the kernel's limit. soak: memory over minutes, the link being down. first-pose: its time."""
    p = argparse.ArgumentParser(description="Trials of the agent that need a process of their own.")
    p.add_argument("trial", choices=("quota", "soak", "first-pose"))
    p.add_argument("source")
    p.add_argument("--percent", type=float, default=0.0)
    p.add_argument("--governor", action="store_true")
    p.add_argument("--no-imu", action="store_true")
    p.add_argument("--frames", type=int, default=0)
    p.add_argument("--minutes", type=float, default=30.0)
    a = p.parse_args(argv)
    cv2.setNumThreads(1)
    if a.trial == "first-pose":
        print(json.dumps({"seconds": _first_pose_s(a.source)}))
        return 0
    clip = load(a.source, imu=not a.no_imu, frames=a.frames)
    warm(clip.rig)
    if a.trial == "soak":
        from kiteline_codec.channel import CodedChannel
        from kiteline_codec.sync import SyncConfig
        from kiteline_hw.cpu import rss_mib

        agent = Agent(clip.rig, None, AgentConfig(), Identity(AgentId(0), 0), CodedChannel(SyncConfig(), 1))
        print(json.dumps({"rss_mib": rss_over_time(clip, a.minutes, agent, rss_mib)}))
        return 0
    with contextlib.ExitStack() as stack:
        if a.percent > 0.0:
            stack.enter_context(CpuQuota(a.percent)).add(os.getpid())
        print(json.dumps(asdict(fly_clip(clip, a.percent, governor=a.governor, real=True))))
    return 0


def _first_pose_s(source: str) -> float:
    """Seconds from the start of this process to its first pose."""
    from kiteline_hw.sources import open_source

    opened = open_source(source)
    warm(opened.rig)
    agent = Agent(opened.rig, opened.imu, AgentConfig(), Identity(AgentId(0), 0), AloneChannel())
    imu = None
    for item in opened:
        if not isinstance(item, Frame):
            imu = item
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

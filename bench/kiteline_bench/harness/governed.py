"""Flights under a CPU limit, modelled or by the kernel, with the governor on or off; and what came of them."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.governor.cost_model import cost_ns
from kiteline_agent.governor.virtual_cpu import VirtualCpu
from kiteline_agent.runtime.frame_reader import joined
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_bench.harness.clip import Clip
from kiteline_core.frame import ImuBatch, Trajectory
from kiteline_core.ids import AgentId
from kiteline_hw.system.cpu import process_cpu_ns
from kiteline_lab.evaluation import metrics

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
    agent = Agent(clip.rig, clip.imu, config, Identity(AgentId(0), 0), NoBaseChannel())
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
    ate_m, rpe_mm = pose_errors(clip, good)
    dropped = sum(e is None for e in estimates)
    span_ns = clip.items[-1][0].t_ns - clip.items[0][0].t_ns + clip.period_ns
    return Governed(
        percent, governor, real, len(estimates), len(good), len(estimates) - len(good) - dropped, dropped,
        len({e.submap for e in good}), 100.0 * float(spent[:, 1].sum()) / span_ns, 100.0 * dearest_window(spent),
        ate_m, rpe_mm, float(np.mean([e.quality for e in good])) if good else 0.0,
    )  # fmt: skip


def pose_errors(clip: Clip, tracked: list[Estimate]) -> tuple[float, float]:
    """ATE in m and relative error in mm a frame of tracked frames; nan with too few of them, or no truth."""
    if clip.truth is None or len(tracked) <= 3:
        return float("nan"), float("nan")
    stamps = np.array([e.t_ns for e in tracked], np.int64)
    found = metrics.evaluate(Trajectory(stamps, np.array([e.T_m_b for e in tracked])), clip.truth)
    relative = found.rpe_frame
    return found.ate_m.rmse, float("nan") if relative is None else 1000.0 * relative.translation_m.rmse


def dearest_window(spent: I64, settled_ns: int = _SETTLED_NS) -> float:
    """The largest share of a core in any one-second window that ends `settled_ns` after the start or later.

    spent: (n,2) time and CPU time in ns, in order of time.
    """
    t_ns, cpu_ns = spent[:, 0], spent[:, 1]
    total = np.concatenate([[0], np.cumsum(cpu_ns)])
    first = np.searchsorted(t_ns, t_ns - _WINDOW_NS, side="right")
    sums = total[1:] - total[first]
    return float(sums[t_ns >= t_ns[0] + settled_ns].max(initial=0)) / _WINDOW_NS

"""Flights on a core of which the agent may use a share: modelled, or limited by the kernel; governor on or off."""

import time
from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import PRICES_NS, cost_ns
from kiteline_agent.governor.virtual_cpu import VirtualCpu
from kiteline_bench.harness.recording import Recording
from kiteline_bench.harness.run import FlyingAgent

_BEGIN_NS = 1_000_000_000  # at the start of a flight, in which no frame is skipped: the map begins
_SKIPPED_NS = round(PRICES_NS["steps"])  # of a frame that is not tracked
_SETTLED_NS = 3_000_000_000  # after the start, from when on the budget has to hold


@dataclass(frozen=True, slots=True)
class LimitedFlight:
    """One flight. percent: of one core, 0 without a limit. load, peak: percent of one core, over the whole flight and
    in the busiest one-second window after 3 s. quality: mean of the tracked frames. delay_ms: 95th percentile of the
    time from a frame's stamp until it is done on the limited core.
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
    delay_ms: float


def fly_limited(
    recording: Recording, percent: float, *, governor: bool, real: bool, every: int = 1, scans: bool = True
) -> LimitedFlight:  # fmt: skip
    """Fly on `percent` of a core. real: paced by the clock, under a limit set elsewhere; else on the modelled core.

    every: after the first second only every so many-th frame is given to the agent. scans: of ground and obstacles.
    """
    config = AgentConfig()
    config = replace(config, scan=replace(config.scan, on=config.scan.on and scans))
    if governor and percent > 0.0:
        config = replace(config, governor=replace(config.governor, cpu_percent=percent))
    agent = FlyingAgent(recording.rig, recording.imu, config, vocabulary=False)
    core, period_ns = VirtualCpu(percent), recording.period_ns
    begin_ns, start_ns = time.monotonic_ns(), recording.items[0].frame.t_ns
    spent_ns = 0
    delays_ns: list[int] = []
    for k, item in enumerate(recording.items):
        t_ns = item.frame.t_ns
        if k % every and t_ns - start_ns >= _BEGIN_NS:
            core.spend(_SKIPPED_NS, t_ns)
            agent.drop(item)
            agent.run.cpu_ns[-1] = _SKIPPED_NS
            continue
        if real:
            late_ns = time.monotonic_ns() - begin_ns - (t_ns - start_ns)
            passed_over = late_ns >= period_ns
            time.sleep(0.0 if passed_over else max(-late_ns, 0) / 1e9)
        else:
            passed_over = core.newest_wins(t_ns, period_ns)
        if passed_over:
            agent.drop(item)
            continue
        cpu_ns = time.process_time_ns()
        agent.step(item, cpu_ns=spent_ns)
        spent_ns = time.process_time_ns() - cpu_ns if real else cost_ns(agent.box.work)
        core.spend(spent_ns, t_ns)
        agent.run.cpu_ns[-1] = spent_ns
        if agent.run.estimates[-1] is not None and not real:
            delays_ns.append((core.free_ns if percent > 0.0 else t_ns + spent_ns) - t_ns)
    run = agent.run
    errors = run.evaluate(run.tracked)
    ate_m = rpe_mm = float("nan")
    if errors is not None:
        ate_m = errors.ate_m.rmse
        rpe_mm = float("nan") if errors.rpe_frame is None else 1000.0 * errors.rpe_frame.translation_m.rmse
    return LimitedFlight(
        percent, governor, real, len(run.estimates), len(run.tracked), run.lost, run.dropped, run.submaps,
        run.load_percent(period_ns), run.peak_percent(_SETTLED_NS), ate_m, rpe_mm,
        float(np.mean([e.quality for e in run.tracked])) if run.tracked else 0.0,
        float(np.percentile(delays_ns, 95)) * 1e-6 if delays_ns else float("nan"),
    )  # fmt: skip

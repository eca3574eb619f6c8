"""What raw images cost the process that tracks, beside encoded ones: two agents fly the same frames in turn."""

import contextlib
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime.agent_runtime import AgentRuntime
from kiteline_agent.runtime.options import AgentOptions
from kiteline_agent.step import StepInput
from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_bench.vehicle.agent_process import favour
from kiteline_core.frame import Frame, ImuBatch
from kiteline_hw.sources.open import open_source

_FRAMES, _WARM = 240, 40  # flown, of which the first do not count
_PERIOD_S = 0.05  # s from frame to frame: encoding goes on meanwhile, in a process of its own
_MOST_MS = 0.3


def run(bench: Bench) -> list[Bar]:
    """CPU time of a step with raw images, less that of the same step with encoded ones; the mean over frames."""
    bench.say("raw images beside encoded ones")
    recording = bench.source("room_flight.mcap")
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.ExitStack() as stack:
        favour(os.getpid())  # as the service; the process that encodes is nicer by ten
        stack.callback(os.setpriority, os.PRIO_PROCESS, 0, before)
        raw, encoded = (_agent(stack, recording, bench.folder / name) for name in ("raw-images", "encoded-images"))
        spent_ms = np.array(list(_fly(recording, raw, encoded)))[_WARM:]
        stored = raw.report()["notes"]
    more = float((spent_ms[:, 0] - spent_ms[:, 1]).mean())
    bench.more.append(
        f"A step takes {spent_ms[:, 1].mean():.2f} ms with encoded images and {spent_ms[:, 0].mean():.2f} ms with raw "
        f"ones, both logged, over {len(spent_ms)} frames{''.join(f'; {note}' for note in stored)}."
    )
    return [at_most("raw images: CPU a frame of the tracking process more than encoded ones", more, _MOST_MS, "ms", 2)]


def _agent(stack: contextlib.ExitStack, recording: str, folder: Path) -> AgentRuntime:
    source = open_source(recording)
    stack.callback(source.close)
    runtime = AgentRuntime(AgentOptions(recording, str(folder)), source, NoBaseChannel(), whole_process=False)
    stack.callback(runtime.close)
    runtime.begin_at(0)
    return runtime


def _fly(recording: str, raw: AgentRuntime, encoded: AgentRuntime) -> list[tuple[float, float]]:
    """CPU time in ms of this process in each frame's steps: with raw images, with encoded ones."""
    out, imu, first_ns, begin_s = list[tuple[float, float]](), None, None, time.monotonic()
    for item in open_source(recording):
        if isinstance(item, ImuBatch):
            imu = item
        if not isinstance(item, Frame):
            continue
        first_ns = item.t_ns if first_ns is None else first_ns
        now_ns = item.t_ns - first_ns
        turns = [(raw, replace(item, encoded=()), 0), (encoded, item, 1)]
        spent = [0.0, 0.0]
        turns = turns[:: 1 if len(out) % 2 else -1]  # the first one has the colder caches
        for runtime, frame, side in turns:
            mark_ns = time.process_time_ns()
            runtime.step(StepInput(frame, imu), now_ns)
            spent[side] += (time.process_time_ns() - mark_ns) * 1e-6
        time.sleep(max(0.0, begin_s + (len(out) + 0.5) * _PERIOD_S - time.monotonic()))
        for runtime, _, side in turns:  # what was encoded meanwhile is written
            mark_ns = time.process_time_ns()
            runtime.step(StepInput(), now_ns + round(0.5e9 * _PERIOD_S))
            spent[side] += (time.process_time_ns() - mark_ns) * 1e-6
        out.append((spent[0], spent[1]))
        if len(out) == _FRAMES:
            break
        time.sleep(max(0.0, begin_s + len(out) * _PERIOD_S - time.monotonic()))
    return out

"""The agent's bars under faults and forced losses: never an exception, a pose again soon, nothing wrong merged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_bench.benchmark import Bar, Bench, at_most, is_true
from kiteline_bench.harness import faults
from kiteline_bench.harness.clip import Clip, load
from kiteline_core.geometry import tum
from kiteline_core.ids import AgentId
from kiteline_core.places.place_index import Vocabulary
from kiteline_hw.system.vocabulary import shipped_vocabulary
from kiteline_lab.flights.fly import Options, fly

_JUMP_M = 0.35  # of the odometry in a frame's time: 7 m/s at 20 Hz
_FRAMES = 360  # 18 s, of which 10 without texture
_SOON = 3  # frames after texture returned


def estimates(clip: Clip, words: Vocabulary | None = None) -> list[Estimate]:
    """What an agent without a base makes of a clip."""
    agent = Agent(clip.rig, clip.imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel(), words)
    found = (agent.step(StepInput(frame, imu), frame.t_ns).estimate for frame, imu in clip.items)
    return [e for e in found if e is not None]


def fault_bars(bench: Bench, depth: Path) -> list[Bar]:
    """Every fault on two eyes with an IMU, on one eye, and on a depth camera. depth: a recording of one."""
    room = bench.source("room_flight.mcap")
    bars = []
    for what, clip in (
        ("pair and IMU", load(room, frames=_FRAMES)),
        ("one eye", load(room, frames=_FRAMES, imu=False, mono=True)),
        ("depth camera", load(str(depth), frames=_FRAMES, imu=False)),
    ):
        for fault in faults.fitting(clip):
            bench.say(f"flying with a fault: {fault} ({what})")
            bars.append(_fault(clip, fault, f"fault, {fault} ({what})"))
    return bars


def _fault(clip: Clip, fault: str, name: str) -> Bar:
    try:
        found = estimates(faults.faulty(clip, fault), shipped_vocabulary())
    except Exception as error:  # the bar is that there is none
        return is_true(name, "no exception", False, repr(error)[:100])
    jump = max(_moved_m(a, b) / max((b.t_ns - a.t_ns) / clip.period_ns, 1.0) for a, b in pairwise(found))
    begun = next((k for k, e in enumerate(found) if e.tracked), len(found))
    lost = sum(not e.tracked for e in found[begun:])
    fine = found[-1].tracked and jump < _JUMP_M
    return is_true(name, f"tracked at the end, odometry moves < {_JUMP_M:g} m a frame", fine,
                   f"{'tracked' if found[-1].tracked else 'lost'}, {lost} frames without a pose, "
                   f"{len({e.submap for e in found})} submaps, jump {jump:.3f} m")  # fmt: skip


def _moved_m(a: Estimate, b: Estimate) -> float:
    return float(np.linalg.norm(b.T_o_b[:3, 3] - a.T_o_b[:3, 3]))


def loss_bars(bench: Bench) -> list[Bar]:
    """Turned into a blank wall and out elsewhere; 2 s of black. With a base, as processes over a link."""
    clip = load(bench.source("room_flight.mcap"), frames=440)
    plain = replace(clip, imu=None)
    wall = [None] * 40  # long enough to come to another place, so that nobody takes the odometry's word for where it is
    there = faults.rearranged(plain, [*range(100), *wall, *range(250, 440)])
    back = faults.rearranged(plain, [*range(100), *wall, *range(250, 330), *wall, *range(60, 140)])
    return [
        *_loss(bench, "wall", "out of the wall at another place", there, [(100, 140)], (2, 2)),
        *_loss(bench, "wall_back", "out at another place, then back", back, [(100, 140), (220, 260)], (2, 3)),
        *_loss(bench, "black", "2 s of black", faults.blind(plain, 200, 240, black=True), [(200, 240)], (1, 2)),
        *_loss(bench, "black_imu", "2 s of black, IMU", faults.blind(clip, 200, 240, black=True), [(200, 240)], (1, 2)),
    ]


def _loss(
    bench: Bench, folder: str, name: str, clip: Clip, holes: Sequence[tuple[int, int]], submaps: tuple[int, int]
) -> list[Bar]:
    """holes: frames that show nothing. submaps: fewest and most that are to be expected."""
    bench.say(f"flying a forced loss: {name}")
    out = bench.folder / f"loss_{folder}"
    out.mkdir(parents=True, exist_ok=True)
    source = clip.save(out / "flight.mcap")
    report, outcome = fly(Options((str(source),), out, imu=clip.imu is not None), quiet=True)
    if outcome.failed:
        raise RuntimeError(f"{name}: {outcome.notes}")
    flown: dict[str, Any] = dict(report)
    agent, base = flown["agents"][0], flown["base"]
    stamps = {line.split()[0] for line in (out / "agent0" / "live.tum").read_text().splitlines()}
    posed = [tum.stamp(frame.t_ns) in stamps for frame, _ in clip.items]
    late = max(next((k for k, good in enumerate(posed[end:]) if good), len(posed)) for _, end in holes)
    lost_later = sum(not good for k, good in enumerate(posed) if not any(a <= k < b + _SOON for a, b in holes))
    low, high = submaps
    return [
        at_most(f"loss, {name}: frames from texture to a pose", late + 1, _SOON, "", 0),
        at_most(f"loss, {name}: lost elsewhere", lost_later, 0, "", 0),
        is_true(f"loss, {name}: submaps", f"{low}" if low == high else f"{low} to {high}",
                low <= agent["submaps"] <= high, f"{agent['submaps']}, {base['merges']} merged"),
        at_most(f"loss, {name}: ATE base of what is placed (nothing wrong merged)", _ate(agent), 0.05, "m", 4),
    ]  # fmt: skip


def _ate(agent: dict[str, Any]) -> float:
    found = agent["accuracy"]["base"]
    return float("inf") if found is None else float(found["ate_m"])

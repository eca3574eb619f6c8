"""The agent's bars: accuracy, cost, the governor beside the same flights without it, faults, memory, first pose."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.alone import AloneChannel
from kiteline_agent.config import AgentConfig
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_core.frame import Frame
from kiteline_core.ids import AgentId
from kiteline_hw.cpu import CpuQuota
from kiteline_lab.benchmark import Bar, Bench, at_most, is_true
from kiteline_lab.clip import Clip, load
from kiteline_lab.fly import Options, fly
from kiteline_lab.governed import Governed, fly_clip
from kiteline_lab.plot_governor import plot_governor

TITLE = "The onboard agent"

_SHARES = (1.0, 0.5, 0.25, 0.12)  # of the flight's own load without a governor
_ATE_RATIO = {0.5: 1.5, 0.25: 3.0}  # that the governor may cost
_SOAK_MINUTES = 30.0
_SOAK_FRAMES = 200  # of the recording, flown to and fro
_PATIENCE_S = 1800.0
_JUMP_M = 0.35  # between two frames of the odometry: 7 m/s at 20 Hz


def run(bench: Bench) -> list[Bar]:
    """All bars, in the order of the promise."""
    bench.say("compiling kernels, so that the flights measure flying")
    _command([sys.executable, "-m", "kiteline_cli", "doctor", "--warm"])
    parts: tuple[Callable[[Bench], list[Bar]], ...] = (
        _room, _kitti, _mono, _governor_modelled, _governor_real, _faults, _first_pose, _soak,
    )  # fmt: skip
    bars: list[Bar] = []
    for part in parts:
        bars += part(bench)
    return bars


# accuracy and cost


def _fly(bench: Bench, name: str, folder: str, **options: Any) -> dict[str, Any]:
    bench.say(f"flying {name} ({folder})")
    report, outcome = fly(Options((bench.source(name),), bench.folder / folder, **options), quiet=True)
    if outcome.failed:
        raise RuntimeError(f"{folder}: {outcome.notes}")
    agent: dict[str, Any] = dict(report)["agents"][0]  # type: ignore[index]
    return agent


def _room(bench: Bench) -> list[Bar]:
    full = _fly(bench, "room_flight.mcap", "agent_room")
    plain = _fly(bench, "room_flight.mcap", "agent_room_no_imu", imu=False)
    alone = _fly(bench, "room_flight.mcap", "agent_room_alone", imu=False, mode="tracker")
    cpu = full["timing"]["cpu_ms_per_frame"]
    a, b, c = (agent["accuracy"]["live"] for agent in (full, plain, alone))
    return [
        at_most("room_flight, IMU and base: ATE live", a["ate_m"], 0.02, "m", 4),
        at_most("room_flight, IMU and base: relative error a frame", a["rpe_mm"], 2.5, "mm", 2),
        at_most("room_flight, base: ATE live", b["ate_m"], 0.03, "m", 4),
        at_most("room_flight, base: relative error a frame", b["rpe_mm"], 4.0, "mm", 2),
        at_most("room_flight, tracker only: ATE live", c["ate_m"], 0.05, "m", 4),
        at_most("room_flight: CPU a frame, mean, IMU, link and log included", cpu["mean"], 5.0, "ms", 2),
        at_most("room_flight: CPU a frame, p95", cpu["p95"], 12.0, "ms", 2),
        at_most("room_flight: resident memory", full["timing"]["rss_mib"], 200.0, "MiB", 0),
    ]


def _kitti(bench: Bench) -> list[Bar]:
    agent = _fly(bench, "kitti_straight", "agent_kitti")
    return [at_most("KITTI size: CPU a frame, mean", agent["timing"]["cpu_ms_per_frame"]["mean"], 9.0, "ms", 2)]


def _mono(bench: Bench) -> list[Bar]:
    bench.say("flying kitti07_mono")
    found = _estimates(load(bench.source("kitti07_mono")))
    first = next((k for k, e in enumerate(found) if e.tracked), len(found))
    lost = sum(not e.tracked for e in found[first:])
    return [
        at_most("kitti07_mono: frames until it has begun", first + 1, 15, "", 0),
        at_most("kitti07_mono: frames lost afterwards", lost, 0, "", 0),
    ]


# the governor


def _governor_modelled(bench: Bench) -> list[Bar]:
    clip = load(bench.source("room_flight.mcap"))

    def flown(percent: float, governor: bool) -> Governed:
        return fly_clip(clip, percent, governor=governor, real=False)

    return _governed(bench, "virtual CPU", flown)


def _governor_real(bench: Bench) -> list[Bar]:
    reason = CpuQuota.unavailable()
    if reason is not None:
        return [is_true("governor under the kernel's limit", "where the machine allows it", True, reason)]
    source = bench.source("room_flight.mcap")

    def flown(percent: float, governor: bool) -> Governed:
        command = [sys.executable, "-m", "kiteline_lab.governed", "quota", source, "--percent", f"{percent}"]
        return Governed(**_json(command + ["--governor"] * governor))

    return _governed(bench, "kernel's limit", flown)


def _governed(bench: Bench, what: str, flown: Callable[[float, bool], Governed]) -> list[Bar]:
    bench.say(f"flying room_flight without a limit ({what})")
    free = flown(0.0, False)
    rows, bars = [(1.0, free)], []
    for share in _SHARES:
        for governor in (True, False):
            bench.say(f"flying room_flight at {100 * share:.0f} % of its load, governor {'on' if governor else 'off'}")
            rows.append((share, flown(share * free.load, governor)))
    for share, flight in rows:
        if not flight.governor:
            continue
        name = f"governor, {what}, {100 * share:.0f} %"
        bars.append(at_most(f"{name}: dearest second, of the budget", flight.peak / flight.percent, 1.0, "", 2))
        if share in _ATE_RATIO:
            bars.append(at_most(f"{name}: ATE over that without a limit", flight.ate_m / free.ate_m, _ATE_RATIO[share],
                                "", 2))  # fmt: skip
        if share >= 0.25:
            bars.append(at_most(f"{name}: lost frames and further submaps", flight.lost + flight.submaps - 1, 0, "", 0))
        else:
            bars.append(is_true(f"{name}: frames are accounted for", "tracked + lost + dropped",
                                flight.tracked + flight.lost + flight.dropped == flight.frames,
                                f"{flight.tracked} + {flight.lost} + {flight.dropped} of {flight.frames}"))  # fmt: skip
    text = governor_table(rows)
    bench.say(text)
    name = "governor_real" if rows[0][1].real else "governor"
    out = Path("docs") if Path("docs").is_dir() else bench.folder
    (out / f"{name}.md").write_text(f"# The CPU governor ({what})\n\n{text}\n\n![CPU against error]({name}.png)\n")
    plot_governor(out / f"{name}.png", [flight for _, flight in rows], f"room_flight, {what}")
    return bars


def governor_table(rows: Sequence[tuple[float, Governed]]) -> str:
    """Markdown of flights, each with its share of the load of the first, which has no limit."""
    heads = (
        "share", "governor", "budget %", "load %", "dearest second %", "tracked", "lost", "dropped", "submaps",
        "ATE mm", "relative mm", "quality",
    )  # fmt: skip
    lines = [
        f"| {' | '.join(heads)} |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for share, f in rows:
        limit = f"{f.percent:.2f}" if f.percent else "none"
        lines.append(
            f"| {100 * share:.0f} % | {'on' if f.governor else 'off'} | {limit} | {f.load:.2f} | {f.peak:.2f} | "
            f"{f.tracked} | {f.lost} | {f.dropped} | {f.submaps} | {1000 * f.ate_m:.1f} | {f.rpe_mm:.2f} | "
            f"{f.quality:.0f} |"
        )
    return "\n".join(lines)


# faults


def _estimates(clip: Clip) -> list[Estimate]:
    agent = Agent(clip.rig, clip.imu, AgentConfig(), Identity(AgentId(0), 0), AloneChannel())
    found = (agent.step(StepInput(frame, imu), frame.t_ns).estimate for frame, imu in clip.items)
    return [e for e in found if e is not None]


def _dark(frame: Frame) -> Frame:
    return replace(frame, left=np.full_like(frame.left, 8), right=_same(frame, 8))


def _same(frame: Frame, value: int) -> Any:
    return None if frame.right is None else np.full_like(frame.right, value)


def _bright(frame: Frame) -> Frame:
    right = None if frame.right is None else np.clip(frame.right * 1.5, 0, 255).astype(np.uint8)
    return replace(frame, left=np.clip(frame.left * 1.5, 0, 255).astype(np.uint8), right=right)


def faulty(clip: Clip, fault: str) -> Clip:
    """A clip with one fault in its middle; stamps stay in order except where that is the fault."""
    items, n, rate = list(clip.items), len(clip.items) // 2, round(1e9 / clip.period_ns)
    spans = {"black": 3, "half a pair": 10, "exposure jump": 10, "covered lens, 2 s": 2 * rate, "no texture": 4 * rate}
    change: dict[str, Callable[[Frame], Frame]] = {
        "black": _dark,
        "covered lens, 2 s": _dark,
        "half a pair": lambda f: replace(f, right=None),
        "exposure jump": _bright,
        "no texture": lambda f: replace(f, left=np.full_like(f.left, 128), right=_same(f, 128)),
    }
    if fault in change:
        for k in range(n, min(n + spans[fault], len(items))):
            items[k] = (change[fault](items[k][0]), items[k][1])
    elif fault == "dropped":
        del items[n : n + 5]
    elif fault == "frozen":
        for k in range(n, n + 5):
            items[k] = (replace(items[n - 1][0], t_ns=items[k][0].t_ns), items[k][1])
    elif fault == "duplicated":
        items.insert(n, (items[n - 1][0], None))
    elif fault == "out of order":
        items[n], items[n + 1] = items[n + 1], items[n]
    else:
        raise ValueError(f"no fault {fault!r}")
    return replace(clip, items=tuple(items))


FAULTS = (
    "dropped", "duplicated", "out of order", "frozen", "black", "half a pair", "exposure jump", "covered lens, 2 s",
    "no texture",
)  # fmt: skip


def _faults(bench: Bench) -> list[Bar]:
    bars = []
    clip = load(bench.source("room_flight.mcap"), frames=180)
    for fault in FAULTS:
        bench.say(f"flying with a fault: {fault}")
        try:
            found = _estimates(faulty(clip, fault))
        except Exception as error:  # the bar is that there is none
            bars.append(is_true(f"fault, {fault}", "no exception", False, repr(error)[:100]))
            continue
        jump = max(float(np.linalg.norm(b.T_o_b[:3, 3] - a.T_o_b[:3, 3])) for a, b in pairwise(found))
        fine = found[-1].tracked and jump < _JUMP_M
        lost = sum(not e.tracked for e in found)
        bars.append(is_true(f"fault, {fault}", f"tracked at the end, odometry jumps < {_JUMP_M:g} m", fine,
                            f"{'tracked' if found[-1].tracked else 'lost'}, {lost} frames without a pose, "
                            f"{len({e.submap for e in found})} submaps, jump {jump:.3f} m"))  # fmt: skip
    return bars


# processes of their own


def _first_pose(bench: Bench) -> list[Bar]:
    bench.say("starting an agent with warm kernels")
    source = bench.source("room_flight.mcap")
    seconds = [_json([sys.executable, "-m", "kiteline_lab.governed", "first-pose", source])["seconds"] for _ in "ab"]
    return [at_most("start of the process to its first pose, warm", min(seconds), 2.0, "s", 2)]


def _soak(bench: Bench) -> list[Bar]:
    bench.say(f"flying {_SOAK_MINUTES:g} minutes to and fro, the link being down")
    source = bench.source("room_flight.mcap")
    minutes = _json([sys.executable, "-m", "kiteline_lab.governed", "soak", source, "--no-imu", "--frames",
                     f"{_SOAK_FRAMES}", "--minutes", f"{_SOAK_MINUTES}"])["rss_mib"]  # fmt: skip
    growth = max(minutes[1:]) - minutes[1]
    return [at_most(f"soak, {_SOAK_MINUTES:g} minutes: memory after minute 2 grows by", growth, 5.0, "MiB", 1)]


def _json(command: list[str]) -> dict[str, Any]:
    done = _command(command)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[1:4])}: {done.stderr[-300:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _command(command: list[str]) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join(entry for entry in sys.path if entry)
    environment = {**os.environ, "PYTHONPATH": paths}
    return subprocess.run(
        command, check=False, env=environment, capture_output=True, text=True, timeout=_PATIENCE_S
    )  # fmt: skip

"""The agent's bars: accuracy, cost, the governor beside the same flights without it, faults, losses, memory, start."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_bench.agent import governor as bench_governor
from kiteline_bench.agent import odometry as bench_agent_odometry
from kiteline_bench.agent.faults import estimates, fault_bars, loss_bars
from kiteline_bench.benchmark import Bar, Bench, Run, at_most
from kiteline_bench.harness import trials
from kiteline_bench.harness.clip import Clip, load
from kiteline_core.frame import Trajectory
from kiteline_core.ids import AgentId
from kiteline_lab.evaluation import metrics
from kiteline_lab.flights import simulate
from kiteline_lab.flights.fly import Options, fly

_SOAK_MINUTES = 30.0
_SOAK_FRAMES = 200  # of the recording, flown to and fro
_SIM_SECONDS = 30.0
# name: scene, trajectory, s into it, seed
SIMULATED = {"MH_03": ("hall", "MH_03_medium.txt", 15.0, 3), "V1_02": ("room", "V1_02_medium.txt", 20.0, 4)}
_DEPTH_SECONDS = 18.0


# accuracy and cost


def _fly(bench: Bench, source: str, folder: str, **options: Any) -> dict[str, Any]:
    bench.say(f"flying {Path(source).name} ({folder})")
    report, outcome = fly(Options((source,), bench.folder / folder, **options), quiet=True)
    if outcome.failed:
        raise RuntimeError(f"{folder}: {outcome.notes}")
    agent: dict[str, Any] = dict(report)["agents"][0]  # type: ignore[index]
    return agent


def _room(bench: Bench) -> list[Bar]:
    room = bench.source("room_flight.mcap")
    full = _fly(bench, room, "agent_room")
    plain = _fly(bench, room, "agent_room_no_imu", imu=False)
    alone = _fly(bench, room, "agent_room_alone", imu=False, mode="tracker")
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
    agent = _fly(bench, bench.source("kitti_straight"), "agent_kitti")
    return [at_most("KITTI size: CPU a frame, mean", agent["timing"]["cpu_ms_per_frame"]["mean"], 9.0, "ms", 2)]


def _simulated(bench: Bench) -> list[Bar]:
    """Flights in the simulator along real ones' paths, with IMU and base."""
    bars = []
    for name in SIMULATED:
        agent = _fly(bench, rendered(bench, name), f"agent_{name}")
        live = agent["accuracy"]["live"]
        bars += [
            at_most(f"{name} in the simulator, IMU and base: ATE live", live["ate_m"], 0.03, "m", 4),
            at_most(f"{name} in the simulator: frames lost, further submaps", agent["lost"] + agent["submaps"] - 1, 0,
                    "", 0),
        ]  # fmt: skip
    return bars


def rendered(bench: Bench, name: str) -> str:
    """The recording of a simulated flight; rendered once, if the folder is kept."""
    scene, trajectory, start_s, seed = SIMULATED[name]
    options = ["--trajectory", bench.source(f"trajectories/{trajectory}"), "--start", f"{start_s}", "--seed", f"{seed}"]
    return _render(bench, name, [scene, *options, "--seconds", f"{_SIM_SECONDS}"])


def _render(bench: Bench, name: str, command: Sequence[str]) -> str:
    out = bench.folder / f"{name}.mcap"
    if not out.exists():
        bench.say(f"rendering {name}")
        bench.folder.mkdir(parents=True, exist_ok=True)
        simulate.main([*command, "--out", str(out)])
    return str(out)


# one eye


def _mono(bench: Bench) -> list[Bar]:
    bench.say("flying kitti07_mono")
    found = estimates(load(bench.source("kitti07_mono")))
    first, lost = _begun(found)
    bars = [
        at_most("kitti07_mono: frames until it has begun", first + 1, 15, "", 0),
        at_most("kitti07_mono: frames lost afterwards", lost, 0, "", 0),
    ]
    for name in SIMULATED:
        bench.say(f"flying {name} with one eye")
        clip = load(rendered(bench, name), mono=True)
        plain = _similar(estimates(replace(clip, imu=None)), clip)
        agent, found = _with_imu(clip)
        metric = _similar([e for e in found if e.submap == agent.submap], clip) if agent.metric else None
        bars += [
            at_most(f"{name}, one eye: Sim3 ATE over {_SIM_SECONDS:g} s", *_ate_of(plain), "m", 4),
            at_most(f"{name}, one eye: frames lost", _begun(found)[1], 0, "", 0),
            at_most(f"{name}, one eye and IMU: scale off by", _off(metric), 5.0, "%", 1),
        ]
    return bars


def _begun(found: Sequence[Estimate]) -> tuple[int, int]:
    """The first frame with a pose, and how many have none after it."""
    first = next((k for k, e in enumerate(found) if e.tracked), len(found))
    return first, sum(not e.tracked for e in found[first:])


def _with_imu(clip: Clip) -> tuple[Agent, list[Estimate]]:
    agent = Agent(clip.rig, clip.imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    found = (agent.step(StepInput(frame, imu), frame.t_ns).estimate for frame, imu in clip.items)
    return agent, [e for e in found if e is not None]


def _similar(found: Sequence[Estimate], clip: Clip) -> metrics.Evaluation | None:
    """Against the truth, the scale being free; None with too little to compare."""
    good = [e for e in found if e.T_m_b is not None]
    if clip.truth is None or len(good) < 20 or len({e.submap for e in good}) > 1:
        return None
    flown = Trajectory(np.array([e.t_ns for e in good], np.int64), np.array([e.T_m_b for e in good]))
    return metrics.evaluate(flown, clip.truth, metrics.TrajectoryAlignment.SIM3)


def _ate_of(found: metrics.Evaluation | None) -> tuple[float, float]:
    return (float("inf") if found is None else found.ate_m.rmse), 0.05


def _off(found: metrics.Evaluation | None) -> float:
    """Percent by which lengths are off; the alignment's scale makes ours true."""
    return float("inf") if found is None else 100.0 * abs(1.0 / found.scale - 1.0)


# the rest


def _odometry(bench: Bench) -> list[Bar]:
    flights = {}
    for name, (scene, trajectory, start_s, seed) in SIMULATED.items():
        path = bench.source(f"trajectories/{trajectory}")
        options = {"trajectory": path, "start": start_s, "seed": seed, "seconds": _SIM_SECONDS}
        flights[name] = bench_agent_odometry.Simulated(rendered(bench, name), scene, options)
    return bench_agent_odometry.bars(bench, flights)


def _governor(bench: Bench) -> list[Bar]:
    return bench_governor.bars(bench, [rendered(bench, name) for name in SIMULATED])


def _losses(bench: Bench) -> list[Bar]:
    return loss_bars(bench)


def _faults(bench: Bench) -> list[Bar]:
    return fault_bars(bench, Path(_render(bench, "depth", ["room", "--depth", "--seconds", f"{_DEPTH_SECONDS}"])))


def _first_pose(bench: Bench) -> list[Bar]:
    bench.say("starting an agent with warm kernels")
    seconds = [trials.start("first-pose", bench.source("room_flight.mcap"))["seconds"] for _ in "ab"]
    return [at_most("start of the process to its first pose, warm", min(seconds), 2.0, "s", 2)]


def _soak(bench: Bench) -> list[Bar]:
    """To and fro for half an hour: the link down and no IMU; the link up and an IMU."""
    room, bars = bench.source("room_flight.mcap"), []
    for what, options in (
        ("link down", ["--no-imu", "--frames", f"{_SOAK_FRAMES}"]),
        ("IMU, link up", ["--link", "--frames", f"{2 * _SOAK_FRAMES}"]),
    ):
        bench.say(f"flying {_SOAK_MINUTES:g} minutes to and fro: {what}")
        found = trials.start("soak", room, "--minutes", f"{_SOAK_MINUTES}", *options)
        growth = max(found["rss_mib"][1:]) - found["rss_mib"][1]
        bars += [
            at_most(f"soak, {_SOAK_MINUTES:g} minutes, {what}: memory after minute 2 grows by", growth, 5.0, "MiB", 1),
            at_most(f"soak, {what}: frames without a pose", found["lost"], 0, "", 0),
        ]
    return bars


# parts of the benchmark


def _warm(bench: Bench) -> None:
    bench.say("compiling kernels, so that the flights measure flying")
    subprocess.run([sys.executable, "-m", "kiteline_cli", "doctor", "--warm"], check=False, capture_output=True)


def _all(*bars: Run) -> Run:
    def run(bench: Bench) -> list[Bar]:
        _warm(bench)
        return [bar for part in bars for bar in part(bench)]

    return run


PARTS = {
    "flights": ("The onboard agent: accuracy and cost", _all(_room, _kitti, _simulated, _first_pose)),
    "mono": ("The onboard agent: one eye", _all(_mono)),
    "odometry": ("The onboard agent: odometry as a prior", _all(_odometry)),
    "governor": ("The onboard agent: under a limit", _all(_governor)),
    "faults": ("The onboard agent: losses and faults", _all(_losses, _faults)),
    "soak": ("The onboard agent: half an hour", _all(_soak)),
}

"""Which front-end: templates, flow or descriptors, in all else the same agent, without a base, on the same flights.

Where a flight begins decides which frames become keyframes, and that moves its ATE by a third. So each flight is flown
several times, each time begun a little later.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import AloneChannel
from kiteline_agent.runtime.warm import warm
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_agent.tracking.tracker import Tracker
from kiteline_bench.agent.front_ends import DescriptorTracker, FlowTracker
from kiteline_bench.benchmark import Bar, Bench, at_most, is_true
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch, Trajectory
from kiteline_core.ids import AgentId
from kiteline_hw.ports import FrameSource
from kiteline_hw.sim.config import read_config
from kiteline_hw.sim.source import SimSource
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.vocabulary import shipped_words
from kiteline_lab.evaluation import metrics
from kiteline_lab.flights.simulate import record

TITLE = "Front-end"

F64 = NDArray[np.float64]

KINDS: dict[str, type[Tracker]] = {"templates": Tracker, "flow": FlowTracker, "descriptors": DescriptorTracker}
_HALL_S, _HALL_START_S = 15.0, 25.0  # the fast part of the path, 1.3 to 1.8 m/s
_STARTS = 4  # flights from as many first frames
_APART = 50  # of a flight's length lies between two of them: one frame of 50
_NOTE = (
    "CPU: process time of a step, without decoding. Errors: the agent alone, aligned without scale, rmse over "
    f"{_STARTS} flights that begin at different frames; keyframes and inliers are their means."
)
_EQUAL = 1.1  # accuracies nearer than this are equal: what another seed of noise changes


@dataclass(frozen=True, slots=True)
class Flown:
    """One front-end on one flight, over all its starts. cpu_ms: (n,) of a step. ate_m, rpe_mm, rpe_deg: rmse.
    keyframes: mean of a flight. inliers: mean of a frame. submaps: the most that one flight took.
    """

    cpu_ms: F64
    ate_m: float
    rpe_mm: float
    rpe_deg: float
    keyframes: float
    inliers: float
    tracked: int
    frames: int
    submaps: int


def run(bench: Bench) -> list[Bar]:
    """The table, and as bars what the choice rests on."""
    cv2.setNumThreads(1)
    flights = _flights(bench)
    results = {}
    for name, opened in flights.items():
        for kind in KINDS:
            bench.say(f"flying {name} by {kind}")
            results[name, kind] = fly(kind, opened)
    bench.more.append(table(results))
    bars = []
    for name in flights:
        ours = results[name, "templates"]
        others = {kind: results[name, kind] for kind in KINDS if kind != "templates"}
        bars.append(is_true(f"{name}: every frame tracked", "all", ours.tracked == ours.frames,
                            f"{ours.tracked} of {ours.frames}"))  # fmt: skip
        best = min((o for o in others.values() if o.tracked == o.frames), key=lambda o: o.rpe_mm, default=None)
        if best is not None:
            bars.append(at_most(f"{name}: relative error, over the best other", ours.rpe_mm / best.rpe_mm, _EQUAL, ""))
        even = [o for o in others.values() if _as_accurate(o, ours)]
        what = f"{name}: CPU, over the cheapest that is as accurate"
        if even:
            cost = min(float(o.cpu_ms.mean()) for o in even)
            bars.append(at_most(what, float(ours.cpu_ms.mean()) / cost, 1.0, ""))
        else:
            bars.append(is_true(what, "<= 1", True, "no other is as accurate"))
    return bars


def table(results: dict[tuple[str, str], Flown]) -> str:
    """All figures as Markdown."""
    heads = (
        "flight", "front-end", "CPU mean ms", "p95", "ATE m", "error a frame mm", "degrees", "keyframes", "inliers",
        "tracked",
    )  # fmt: skip
    lines = [_NOTE, "", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for (name, kind), r in results.items():
        tracked = "all" if r.tracked == r.frames else f"{r.tracked} of {r.frames}, {r.submaps} submaps"
        lines.append(
            f"| {name} | {kind} | {r.cpu_ms.mean():.2f} | {np.percentile(r.cpu_ms, 95):.2f} | {r.ate_m:.4f} | "
            f"{r.rpe_mm:.2f} | {r.rpe_deg:.4f} | {r.keyframes:.0f} | {r.inliers:.0f} | {tracked} |"
        )
    return "\n".join(lines)


def _as_accurate(other: Flown, ours: Flown) -> bool:
    near = other.rpe_mm <= _EQUAL * ours.rpe_mm and other.ate_m <= _EQUAL * ours.ate_m
    return near and other.tracked == other.frames


def fly(kind: str, opened: Callable[[], FrameSource], starts: int = _STARTS) -> Flown:
    """Fly a source by one front-end, from as many first frames. Raises SourceError."""
    flown = []
    for k in range(starts):
        source = opened()
        first = k * max(1, (source.frame_count or 0) // _APART)
        flown.append(_flown(source, *_steps(_agent(kind, source), _from(source, first))))
    return Flown(
        np.concatenate([f.cpu_ms for f in flown]), _rms([f.ate_m for f in flown]), _rms([f.rpe_mm for f in flown]),
        _rms([f.rpe_deg for f in flown]), float(np.mean([f.keyframes for f in flown])),
        float(np.mean([f.inliers for f in flown])), sum(f.tracked for f in flown), sum(f.frames for f in flown),
        max(f.submaps for f in flown),
    )  # fmt: skip


def _flown(source: FrameSource, cpu_ms: F64, estimates: Sequence[Estimate]) -> Flown:
    truth = source.ground_truth
    assert truth is not None, "a flight without truth says nothing about accuracy"
    posed = [(e.t_ns, e.T_m_b) for e in estimates if e.T_m_b is not None]
    found = metrics.evaluate(Trajectory(np.array([t for t, _ in posed]), np.array([T for _, T in posed])), truth)
    assert found.rpe_frame is not None
    return Flown(
        cpu_ms, found.ate_m.rmse, 1000.0 * found.rpe_frame.translation_m.rmse, found.rpe_frame.rotation_deg.rmse,
        len({e.keyframe for e in estimates}), float(np.mean([e.inliers for e in estimates[1:]])),
        sum(e.tracked for e in estimates), len(estimates), len({e.submap for e in estimates}),
    )  # fmt: skip


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _from(items: Iterable[Frame | ImuBatch | OdometryBatch], first: int) -> Iterator[Frame | ImuBatch]:
    """Images and inertial samples after the first so many frames."""
    for item in items:
        if isinstance(item, OdometryBatch):
            continue
        if first == 0:
            yield item
        else:
            first -= isinstance(item, Frame)


def _agent(kind: str, source: FrameSource) -> Agent:
    config, identity, words = AgentConfig(), Identity(AgentId(0), 0), shipped_words()
    warm(source.rig, config)
    return Agent(source.rig, source.imu, config, identity, AloneChannel(), words, KINDS[kind])


def _steps(agent: Agent, items: Iterable[Frame | ImuBatch]) -> tuple[F64, list[Estimate]]:
    cpu_ms: list[float] = []
    estimates: list[Estimate] = []
    imu: ImuBatch | None = None
    for item in items:
        if isinstance(item, ImuBatch):
            imu = item
            continue
        begin_ns = time.process_time_ns()
        estimate = agent.step(StepInput(item, imu), item.t_ns).estimate
        cpu_ms.append((time.process_time_ns() - begin_ns) / 1e6)
        assert estimate is not None
        estimates.append(estimate)
        imu = None
    return np.array(cpu_ms), estimates


def _flights(bench: Bench) -> dict[str, Callable[[], FrameSource]]:
    room, kitti = bench.source("room_flight.mcap"), bench.source("kitti_straight")
    bench.say("rendering a hall")
    hall = bench.folder / "hall.mcap"
    _record_hall(hall, bench.source("trajectories/MH_03_medium.txt"))
    return {
        "room_flight": lambda: open_source(room),
        "room_flight, no IMU": lambda: open_source(room, imu=False),
        "kitti_straight": lambda: open_source(kitti),
        "simulated hall": lambda: open_source(str(hall)),
    }


def _record_hall(path: Path, trajectory: str) -> None:
    if path.exists():
        return
    config = read_config("hall", trajectory=trajectory, seed=3, seconds=_HALL_S, start=_HALL_START_S)
    path.parent.mkdir(parents=True, exist_ok=True)
    record(SimSource(config, os.cpu_count() or 1, None), path)

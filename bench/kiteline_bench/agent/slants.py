"""What the slants of surfaces are worth: flights with them beside the same flights without."""

import os
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from kiteline_agent.config import AgentConfig, SlantConfig
from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.recording import Recording, items_of, load
from kiteline_bench.harness.result import AgentRun
from kiteline_bench.harness.run import fly_alone
from kiteline_bench.harness.simulated import NAMES, simulated
from kiteline_hw.sim.source import open_sim

_STREETS = ((51, 0.11), (52, 0.3), (53, 0.11), (54, 0.3))  # seed, baseline in m
_STREET_SECONDS, _STREET_HZ, _APART_S = 12.0, 10.0, 5.0
_SECONDS = 10.0
_STARTS_S = (0.0, 10.0, 20.0)  # of such parts of simulated flights
_ROOM_STARTS_S = (0.0, 8.0)  # of room_flight
_KITTI_STARTS_S = (0.0, 0.6)
_FRAME, _FRAME_WORST, _ATE, _CPU = 0.95, 1.15, 0.95, 1.06
_FACING = SlantConfig(points=0)  # all surfaces face the camera


def run(bench: Bench) -> list[Bar]:
    """Error of a frame, ATE and CPU of the agent alone, over those of surfaces that face the camera."""
    rows: list[tuple[object, ...]] = []
    frame, ate, cpu = list[float](), list[float](), list[float]()
    for name, recording in _recordings(bench):
        bench.say(f"flying {name}")
        facing = fly_alone(recording, replace(AgentConfig(), slant=_FACING))
        slanted = fly_alone(recording)
        step_mm, ate_mm, cpu_ms = (
            [what(run) for run in (facing, slanted)]
            for what in (_step_mm, lambda run: 1000.0 * run.ate_m("o"), _cpu_ms)
        )
        for ratios, (before, after) in zip((frame, ate, cpu), (step_mm, ate_mm, cpu_ms), strict=True):
            ratios.append(after / before)
        rows.append((name, *step_mm, *ate_mm, cpu[-1]))
    columns = ("flight", "mm a frame, facing", "slanted", "ATE mm, facing", "slanted", "CPU a frame over facing")
    table(bench, "The agent alone", columns, rows)
    n = len(rows)
    return [
        at_most(f"slants: error of a frame over that without, median of {n}", float(np.median(frame)), _FRAME, "", 2),
        at_most("slants: error of a frame over that without, worst", float(np.max(frame)), _FRAME_WORST, "", 2),
        at_most(f"slants: ATE over that without, median of {n}", float(np.median(ate)), _ATE, "", 2),
        at_most(f"slants: CPU a frame over that without, median of {n}", float(np.median(cpu)), _CPU, "", 2),
    ]


def _step_mm(run: AgentRun) -> float:
    """Relative error of a frame, rms."""
    found = run.evaluate(run.tracked, frame="o")
    return float("inf") if found is None or found.rpe_frame is None else 1000.0 * found.rpe_frame.translation_m.rmse


def _cpu_ms(run: AgentRun) -> float:
    """Median CPU time of a frame."""
    return float(np.median(run.cpu_ns)) * 1e-6


def _recordings(bench: Bench) -> Iterator[tuple[str, Recording]]:
    kitti, room = load(bench.source("kitti_straight")), load(bench.source("room_flight.mcap"))
    for start_s in bench.chosen(_KITTI_STARTS_S):
        yield f"kitti_straight from {start_s:g} s", kitti.seconds(start_s, 1e9)
    flights = [("room_flight", room, bench.chosen(_ROOM_STARTS_S))]
    flights += [(name, load(simulated(bench, name).recording), bench.chosen(_STARTS_S)) for name in NAMES]
    for name, flight, starts_s in flights:
        for start_s in starts_s:
            part, what = flight.seconds(start_s, start_s + _SECONDS), f"{name} from {start_s:g} s"
            yield from ((what, part), (f"{what}, no IMU", part.without_imu()))
    for seed, baseline in bench.chosen(_STREETS):
        source = open_sim(
            "street", os.cpu_count() or 1, seed=seed, baseline=baseline, seconds=_STREET_SECONDS, rate=_STREET_HZ,
            start=_APART_S * (seed - _STREETS[0][0]),
        )  # fmt: skip
        items = tuple(replace(item, imu=None) for item in items_of(source))
        yield f"street {seed}, {baseline:g} m", Recording(source.rig, None, items)

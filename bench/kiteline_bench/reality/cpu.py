"""CPU of the agent over a yardstick of the same machine in the same minute: ORB on the flight's own images.

The agent is flown as in any flight: a process of its own, with IMU, link and log. Its CPU is that of the whole process,
all threads and rectification included, image decoding taken off. Yardstick and flights alternate, and flights with and
without scans of ground and obstacles, which are the grid's cost and not that of flying.

Usage: python -m kiteline_bench.reality.cpu SOURCE    prints the yardstick of a recording as JSON.
"""

import json
import sys
import time
from itertools import islice
from statistics import median
from typing import Any

import cv2
import numpy as np

from kiteline_bench.harness import processes
from kiteline_bench.harness.bars import Bar, Bench, at_most, run_command
from kiteline_core.frame import Frame
from kiteline_hw.sources.open import open_source

RUNS = 5
FLIGHTS = ("room_flight.mcap", "euroc_mh01_air", "kitti_straight")  # stereo and IMU, monocular with IMU, stereo
_GRIDS = {"off": "", "agent": ", with scans"}  # options of a flight: their names in a bar
_CORNERS = 1000  # of the yardstick, cv2.ORB_create
_EVERY = 4  # images of which one is measured
_MEAN, _P95 = 0.95, 2.3  # over the yardstick
_RSS_MIB, _FIRST_POSE_S = 200.0, 2.0
_MEDIAN = f"median of {RUNS} runs"
_TIMEOUT_S = 300.0


def yardstick_ms(source: str, *, rest_s: float = 0.0, images: int | None = None) -> list[float]:
    """CPU in ms of cv2.ORB_create(1000).detectAndCompute on every fourth left image, on one thread.

    rest_s: before each, as between the frames of a flight; some machines make memory slow that rests.
    images: the first ones alone; None for all.
    """
    cv2.setNumThreads(1)
    orb, spent = cv2.ORB_create(_CORNERS), []  # type: ignore[attr-defined]
    frames = (item for item in open_source(source) if isinstance(item, Frame))
    for frame in islice(frames, 0, None if images is None else images * _EVERY, _EVERY):
        time.sleep(rest_s)
        begin_ns = time.thread_time_ns()
        orb.detectAndCompute(frame.left, None)
        spent.append((time.thread_time_ns() - begin_ns) / 1e6)
    return spent[1:]  # the first one allocates


def _measured_ms(source: str) -> list[float]:
    """The yardstick of a recording, in a process of its own."""
    done = run_command([sys.executable, "-m", "kiteline_bench.reality.cpu", source], _TIMEOUT_S)
    if done.returncode:
        raise RuntimeError(f"yardstick of {source}: {done.stderr[-300:]}")
    spent: list[float] = json.loads(done.stdout.splitlines()[-1])
    return spent


def over_yardstick(cpu_ms: dict[str, float], before: list[float], after: list[float]) -> tuple[float, float, float]:
    """Yardstick in ms, the median of what was measured before and after a flight; mean and p95 of its CPU over it."""
    unit_ms = float(np.median([*before, *after]))
    return unit_ms, cpu_ms["mean"] / unit_ms, cpu_ms["p95"] / unit_ms


def _flight(bench: Bench, name: str) -> list[Bar]:
    source = bench.source(name)
    found: dict[str, list[tuple[float, float, float]]] = {grid: [] for grid in _GRIDS}
    rss_mib = 0.0
    before = _measured_ms(source)
    for k in range(RUNS):
        for grid in _GRIDS:
            flown = bench.fly(source, f"cpu_{name.partition('.')[0]}_{grid}_{k}", grid=grid)
            timing: dict[str, Any] = flown.agent()["timing"]
            after = _measured_ms(source)
            found[grid].append(over_yardstick(timing["cpu_ms_per_frame"], before, after))
            rss_mib = max(rss_mib, timing["rss_mib"])
            before = after
    bars = []
    for grid, what in _GRIDS.items():
        listed = ", ".join(f"{unit:.2f} ms: {mean:.2f} / {p95:.2f}" for unit, mean, p95 in found[grid])
        bench.more.append(f"{name}{what}, yardstick: mean / p95 of each run: {listed}.")
        means, p95s = ([run[column] for run in found[grid]] for column in (1, 2))
        bars += [
            at_most(f"{name}{what}: CPU a frame over the yardstick, {_MEDIAN}", median(means), _MEAN, "", 2),
            at_most(f"{name}{what}: p95 over the yardstick, {_MEDIAN}", median(p95s), _P95, "", 2),
        ]
    return [*bars, at_most(f"{name}: resident memory", rss_mib, _RSS_MIB, "MiB", 0)]


def run(bench: Bench) -> list[Bar]:
    """CPU and memory on three recordings, and the time to the first pose."""
    bench.warm()
    bars = [bar for name in FLIGHTS for bar in _flight(bench, name)]
    bench.say("starting an agent with compiled kernels")
    seconds = [processes.start("first-pose", bench.source(FLIGHTS[0]))["seconds"] for _ in range(3)]
    bars.append(at_most("start of the process to its first pose, warm", min(seconds), _FIRST_POSE_S, "s", 2))
    return bars


if __name__ == "__main__":
    print(json.dumps(yardstick_ms(sys.argv[1])))

"""What grids cost an agent and the link: CPU of a scan and of the frames it is spread over, bytes up and down."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.scans.local_grid import LocalGrid
from kiteline_bench.grid.scans import Scanner
from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.run import fly_alone, fly_recording
from kiteline_codec.schema.base.grid_tile import TILE_CELLS

_ROUNDS = 3  # flights with and without scans, in turn
_WARM = 3  # scans before time is taken
_EVERY = 10  # frames between two scans
_P95 = 1.05  # of the frames without scans
_AGENT_MIB = 4.0


def run(bench: Bench) -> list[Bar]:
    """The recorded room."""
    recording = load(bench.source("room_flight.mcap"))
    return [*_scan_cpu(bench, recording), *_frames(bench, recording), *_bytes(bench, recording), _agent_memory()]


def _scan_cpu(bench: Bench, recording: Recording) -> list[Bar]:
    bench.say("scanning room_flight")
    scanner, taken = Scanner(recording.rig), []
    for item in recording.items[::_EVERY]:
        if item.frame.right is None or item.T_w_b is None:
            continue
        begin = time.process_time_ns()
        scanner.scan(item.frame, item.T_w_b)
        taken.append((time.process_time_ns() - begin) * 1e-6)
    return [at_most("a scan: CPU, rectification included, median", float(np.median(taken[_WARM:])), 10.0, "ms", 1)]


def _frames(bench: Bench, recording: Recording) -> list[Bar]:
    """CPU of a frame with scans over that without, in alternation."""
    on = AgentConfig()
    off = replace(on, scan=replace(on.scan, on=False))
    mean: dict[bool, list[float]] = {True: [], False: []}
    p95: dict[bool, list[float]] = {True: [], False: []}
    for k in range(_ROUNDS):
        for scans in (True, False):
            bench.say(f"flying room_flight {'with' if scans else 'without'} scans ({k + 1} of {_ROUNDS})")
            cpu = np.array(fly_alone(recording, on if scans else off).cpu_ns[40:]) * 1e-6
            mean[scans].append(float(cpu.mean()))
            p95[scans].append(float(np.quantile(cpu, 0.95)))
    bench.more.append(
        f"A frame without scans: {np.median(mean[False]):.2f} ms, p95 {np.median(p95[False]):.2f}; with scans "
        f"{np.median(mean[True]):.2f} ms, p95 {np.median(p95[True]):.2f}."
    )
    ratio = float(np.median(np.array(p95[True]) / np.array(p95[False])))
    return [at_most("p95 of a frame's CPU with scans, over that without", ratio, _P95, "", 3)]


def _bytes(bench: Bench, recording: Recording) -> list[Bar]:
    """Bytes that scans add to a flight with a base, for each of them."""
    on = AgentConfig()
    bench.say("flying room_flight with a base, with and without scans")
    a, b = (fly_recording(recording, config) for config in (on, replace(on, scan=replace(on.scan, on=False))))
    scans = max(len(a.station.mapper.grid), 1)
    up, down = ((getattr(a.agent, name) - getattr(b.agent, name)) / scans for name in ("bytes_up", "bytes_down"))
    bench.more.append(f"{scans} scans are drawn at the end of the flight with a base.")
    return [
        at_most("bytes up that scans add to a flight, for each scan", up, 200.0, "B", 0),
        at_most("bytes down that tiles add to a flight, for each scan", down, 150.0, "B", 0),
    ]


def _agent_memory() -> Bar:
    """The agent's grid at its largest."""
    config = AgentConfig().local_grid
    arrays = [v for v in vars(LocalGrid(config)).values() if isinstance(v, np.ndarray)]
    own: NDArray[np.int64] = np.array([v.nbytes for v in arrays])
    mib = (int(own.sum()) + config.tiles * TILE_CELLS**2) / 2**20
    return at_most("the agent's grid: own cells and the most tiles that it keeps", mib, _AGENT_MIB, "MiB", 2)

"""The base's grid as a map: equal to one from scratch after corrections, and what it costs in time and memory."""

import copy
import time
from collections.abc import Sequence

import numpy as np

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.kept_scan import KeptScan, keep
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_bench.grid.scans import PosedScan, Scanner, grid_config, scans_of
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.recording import load
from kiteline_core.arrays import F64, I8
from kiteline_core.geometry import se3
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_hw.system.memory import rss_mib

Drawn = Sequence[tuple[KeptScan, F64]]

_MOVED_M = 0.5  # of the last keyframe by a loop closure, in proportion along the way
_AT_ONCE = 100
_ROADS_M, _BETWEEN_M, _STEP_M = 10_000.0, 2_000.0, 5.0  # length of a road, between two roads, between two keyframes
_WARM = 20  # scans that are drawn before time is taken


def run(bench: Bench) -> list[Bar]:
    """The recorded room's scans, then scans along roads."""
    recording = load(bench.source("room_flight.mcap"))
    bench.say("scanning room_flight")
    posed = scans_of(recording, 2)
    config, bf = grid_config(posed), Scanner(recording.rig).camera.bf
    scans = _kept(config, posed, bf)
    return [*_after_a_loop(config, scans), *_costs(config, scans), *_roads(bench)]


def _kept(config: GridConfig, posed: Sequence[PosedScan], bf: float) -> Drawn:
    found = ((keep(config, p.scan, bf), p.T_w_c) for p in posed)
    return [(kept, pose) for kept, pose in found if kept is not None]


def _grid(config: GridConfig, scans: Drawn) -> ScanGrid:
    grid = ScanGrid(config)
    for k, (kept, pose) in enumerate(scans):
        grid.put(k, kept, pose)
    return grid


def _moved(scans: Drawn, first: int) -> Drawn:
    """The scans, from a number on at poses as a loop closure leaves them: turned and moved, the last one most."""
    out = list(scans)
    for k in range(first, len(scans)):
        share = (k - first + 1) / (len(scans) - first)
        change = se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, 0.03 * share])), share * np.array([_MOVED_M, -0.1, 0.02]))
        out[k] = scans[k][0], change @ scans[k][1]
    return out


def _after_a_loop(config: GridConfig, scans: Drawn) -> list[Bar]:
    """A corrected grid beside one that is drawn with the final poses alone, in another order."""
    grid, final = _grid(config, scans), _moved(scans, len(scans) // 4)
    before = _states(grid)
    for k, (kept, pose) in enumerate(final):
        grid.put(k, kept, pose)
    scratch = ScanGrid(config)
    for k in np.random.default_rng(0).permutation(len(final)).tolist():
        scratch.put(k, *final[k])
    after, wanted = _states(grid), _states(scratch)
    same = after.keys() == wanted.keys() and all(np.array_equal(after[p], wanted[p]) for p in wanted)
    changed = sum(p not in before or not np.array_equal(before[p], after[p]) for p in after)
    return [is_true(f"{len(scans)} keyframes, a loop closure that moves them by up to {_MOVED_M:g} m: the grid",
                    "equals one from scratch", same and changed > 0,
                    f"{len(after)} tiles, {changed} changed, {'all equal' if same else 'not equal'}")]  # fmt: skip


def _states(grid: ScanGrid) -> dict[object, I8]:
    states = {place: grid.cells(place) for place in grid.places}
    return {place: cells for place, (cells, known) in states.items() if known}


def _costs(config: GridConfig, scans: Drawn) -> list[Bar]:
    """CPU time and memory of updates."""
    grid, taken = ScanGrid(config), []
    for k, (kept, pose) in enumerate(scans):
        begin = time.process_time_ns()
        grid.put(k, kept, pose)
        if k >= _WARM:
            taken.append((time.process_time_ns() - begin) * 1e-6)
    n = min(_AT_ONCE, len(scans))
    moved = _moved(scans, len(scans) - n)
    whole = []
    for _ in range(3):
        again = copy.deepcopy(grid)
        begin = time.process_time_ns()
        for k in range(len(scans) - n, len(scans)):
            again.put(k, *moved[k])
        whole.append((time.process_time_ns() - begin) * 1e-6)
    mb = grid.nbytes / 1e6 / len(scans)
    return [
        at_most("base, an update without corrections: CPU, median", float(np.median(taken)), 2.0, "ms", 2),
        at_most(f"base, {n} keyframes moved at once: CPU", float(np.median(whole)), 200.0, "ms", 0),
        at_most("base, memory of tiles and scans an update (Segfloor: 0.073)", mb, 0.05, "MB", 4),
    ]


def _roads(bench: Bench) -> list[Bar]:
    """10 by 10 km along roads: memory by the tiles that were touched."""
    roads = int(_ROADS_M / _BETWEEN_M) + 1
    config, rng = GridConfig(), np.random.default_rng(5)
    kept = [keep(config, road_scan(rng), 0.5 * 700.0 * 0.5) for _ in range(16)]
    grid, before, k = ScanGrid(config), rss_mib(), 0
    bench.say(f"driving {2 * roads} roads of {_ROADS_M / 1000:g} km")
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    begin = time.process_time_ns()
    for along in (0, 1):
        turn = se3.so3_exp(np.array([0.0, 0.0, 0.5 * np.pi * along])) @ level
        for road in range(roads):
            for s in np.arange(0.0, _ROADS_M, _STEP_M):
                at = np.array([s, road * _BETWEEN_M, config.ground_m + 1.6])
                scan = kept[k % len(kept)]
                assert scan is not None
                grid.put(k, scan, se3.from_rt(turn, at if along == 0 else at[[1, 0, 2]]))
                k += 1
    cpu_ms = (time.process_time_ns() - begin) * 1e-6 / k
    grown = (rss_mib() - before) * 1.048576
    bench.more.append(
        f"Roads: {k} keyframes, {len(grid.places)} tiles, {grid.nbytes / 1e6:.0f} MB of tiles and scans, "
        f"{cpu_ms:.2f} ms of CPU an update."
    )
    return [at_most(f"10 x 10 km along {2 * roads} roads: memory of the process", grown, 300.0, "MB", 0)]


def road_scan(rng: np.random.Generator) -> ColumnScan:
    """A road of 8 m between houses, with parked cars: free ahead, obstacles beside it."""
    n, step = 64, np.radians(1.25)
    azimuth = (np.arange(n) - 0.5 * (n - 1)) * step
    beside = np.where(rng.random(n) < 0.3, 2.5, 4.0) + rng.normal(0.0, 0.05, n)
    wall = np.abs(beside / np.maximum(np.abs(np.sin(azimuth)), 1e-3))
    obstacle = np.where(wall < 18.0, wall, np.inf)
    free = np.minimum(wall, 15.0) - 0.1
    bands = np.where(np.isfinite(obstacle), rng.integers(1, 8, n), 0).astype(np.uint8)
    up_c = np.array([0.0, -1.0, 0.0])
    return ColumnScan(up_c, float(azimuth[0]), float(step), np.full(n, 2.5), free, obstacle, bands, free.copy(), 1.6)

"""The base's bars of keeping: killed fifty times in one flight, yesterday's map, and what writing costs."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.station import Station
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.store import read
from kiteline_bench.benchmark import Bar, Bench, at_most, is_true
from kiteline_bench.harness import ratios as bench_ratios
from kiteline_codec.channel import CodedChannel
from kiteline_codec.sync.config import SyncConfig
from kiteline_hw.system.vocabulary import shipped_vocabulary
from kiteline_lab.evaluation import trajectories
from kiteline_lab.flights import simulate
from kiteline_lab.flights.flight import Outcome
from kiteline_lab.flights.fly import Options, fly
from kiteline_lab.tools import logs

_DEATHS = 50
_STARTS_S = (0.0, 15.0, 30.0)  # of the flights that are killed
_FIRST_S = 2.0  # s of flight before which nothing is kept yet
_DELAY_S = 0.05  # s of real time after the drawn instant within which the base is killed: anywhere in a step or a batch
_TRAJECTORY = "trajectories/MH_03_medium.txt"


def run(bench: Bench) -> list[Bar]:
    """All bars."""
    return [*_deaths(bench), *_yesterday(bench), *_cost(bench)]


def _fly(bench: Bench, source: str, folder: str, **options: Any) -> tuple[dict[str, Any], Outcome]:
    bench.say(f"flying {folder}")
    report, outcome = fly(Options((source,), bench.folder / folder, **options), quiet=True)
    if outcome.failed:
        raise RuntimeError(f"{folder}: {outcome.notes}")
    return dict(report), outcome


def _store(bench: Bench, name: str) -> Path:
    store = bench.folder / name
    shutil.rmtree(store, ignore_errors=True)
    return store


def _deaths(bench: Bench) -> list[Bar]:
    """Flights through the hall in peace, and the same in which the base is killed again and again."""
    hall, pairs = _hall(bench), []
    bars: list[Bar] = []
    for seed, start_s in enumerate(_STARTS_S, start=1):
        source = hall
        if start_s > 0.0:
            source = bench_ratios.cut(bench, hall, f"store_from_{start_s:g}", start_s, bench_ratios.length_s(hall))
        calm, _ = _fly(bench, str(source), f"store_calm{seed}")
        killed, outcome = _killed(bench, source, seed)
        pairs.append((_error_m(killed), _error_m(calm)))
        if not bars:
            bars = _whole(bench, killed, outcome)
    ratio = bench_ratios.bar(bench, "final ATE of killed flights over that of undisturbed ones, by start", pairs, 1.1)
    return [bars[0], ratio, *bars[1:]]


def _killed(bench: Bench, source: Path, seed: int) -> tuple[dict[str, Any], Outcome]:
    """A flight in which the base is killed at random instants."""
    random = np.random.default_rng(seed)
    at_s = np.sort(random.uniform(_FIRST_S, 0.97 * bench_ratios.length_s(source), _DEATHS))
    deaths = tuple(zip(at_s.tolist(), random.uniform(0.0, _DELAY_S, _DEATHS).tolist()))
    store = _store(bench, f"store_of_killed{seed}")
    return _fly(bench, str(source), f"store_killed{seed}", store=str(store), base_deaths=deaths)


def _error_m(report: dict[str, Any]) -> float:
    return float(report["agents"][0]["accuracy"]["base"]["ate_m"])


def _whole(bench: Bench, killed: dict[str, Any], outcome: Outcome) -> list[Bar]:
    """Whether the first killed flight lost anything."""
    faults = [fault for restored in outcome.restored for fault in restored["faults"]]
    agent, base = killed["agents"][0], killed["base"]
    last = restore(
        Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1), shipped_vocabulary()),
        read(bench.folder / "store_of_killed1"), 0,
    )  # fmt: skip
    return [
        is_true(f"kill -9 at {_DEATHS} random instants of one flight: consistency check after each restart", "passes",
                len(outcome.restored) == _DEATHS and not faults,
                f"{len(outcome.restored)} restarts, {len(faults)} faults"),
        is_true("its keyframes, in the map and in the store", "all",
                base["keyframes"] == agent["keyframes"] == last.keyframes and not last.faults,
                f"{base['keyframes']} and {last.keyframes} of {agent['keyframes']}"),
        is_true("its digests at the end", "equal", base["digest_equal"] is True),
    ]  # fmt: skip


def _hall(bench: Bench) -> Path:
    """A flight through the hall; the one of the mapper's bars, where it has been rendered."""
    rendered = bench.folder / "hall-1.mcap"
    if rendered.exists():
        return rendered
    out = bench.folder / "store_hall.mcap"
    if not out.exists():
        bench.say("rendering the hall")
        bench.folder.mkdir(parents=True, exist_ok=True)
        simulate.main(["hall", "--trajectory", bench.source(_TRAJECTORY), "--out", str(out)])
    return out


def _yesterday(bench: Bench) -> list[Bar]:
    """Half a flight, all is stopped, and the rest with the same store, by another start of agent and base."""
    whole = bench.source("room_flight.mcap")
    stamps = trajectories.read(f"mcap:{whole}").trajectory.t_ns
    length_s = float(stamps[-1] - stamps[0]) * 1e-9
    store, reports = str(_store(bench, "store_of_days")), []
    for day, (begin_s, end_s) in enumerate(((0.0, 0.6 * length_s), (0.4 * length_s, length_s))):
        piece = bench.folder / f"day{day}.mcap"
        bench.folder.mkdir(parents=True, exist_ok=True)
        logs.main(["cut", "--from", f"{begin_s:.3f}", "--to", f"{end_s:.3f}", "--force", whole, str(piece)])
        reports.append(_fly(bench, str(piece), f"store_day{day}", store=store)[0])
    second = reports[1]
    return [
        is_true("flown against yesterday's map: one map of both days", "merged", second["base"]["merges"] >= 1,
                f"{second['base']['merges']} merges, {second['base']['keyframes']} keyframes"),
        at_most("the second day's ATE base", second["agents"][0]["accuracy"]["base"]["ate_m"], 0.02, "m", 4),
    ]  # fmt: skip


def _cost(bench: Bench) -> list[Bar]:
    """The mapper's step with and without a store."""
    room = bench.source("room_flight.mcap")
    without, _ = _fly(bench, room, "store_without")
    kept, _ = _fly(bench, room, "store_with", store=str(_store(bench, "store_of_room")))
    step_ms = [report["base"]["timing"]["step_ms"]["p95"] for report in (kept, without)]
    size_kb = (bench.folder / "store_of_room" / "map.sqlite").stat().st_size / 1000.0
    bench.more.append(
        f"`room_flight` takes {size_kb:.0f} kB on disk, {size_kb / kept['base']['keyframes']:.1f} kB a keyframe."
    )
    return [at_most("CPU of a step, p95, that a store adds", step_ms[0] - step_ms[1], 1.0, "ms", 2)]

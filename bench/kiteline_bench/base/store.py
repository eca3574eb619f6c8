"""The bars of the base's store: fifty kills in one flight, an earlier session's map, and the cost of writing."""

import shutil
from pathlib import Path

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.station import Station
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.store import read
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.result import FlownProcesses
from kiteline_bench.harness.simulated import rendered_paths
from kiteline_bench.harness.starts import cut, length_s, median_ratio
from kiteline_codec.channel import CodedChannel
from kiteline_codec.sync.config import SyncConfig
from kiteline_hw.system.vocabulary import shipped_vocabulary

_DEATHS = 50
_STARTS_S = (0.0, 15.0, 30.0)  # of the flights that are killed
_FIRST_S = 2.0  # s of flight before which nothing is kept yet
_DELAY_S = 0.05  # s of real time after the drawn instant within which the base is killed: anywhere in a step or a batch


def run(bench: Bench) -> list[Bar]:
    """All bars."""
    return [*_deaths(bench), *_yesterday(bench), *_cost(bench)]


def _store(bench: Bench, name: str) -> Path:
    store = bench.folder / name
    shutil.rmtree(store, ignore_errors=True)
    return store


def _deaths(bench: Bench) -> list[Bar]:
    """Undisturbed flights through the hall, and the same in which the base is killed again and again."""
    hall, pairs = _hall(bench), []
    first: FlownProcesses | None = None
    for seed, start_s in enumerate(_STARTS_S, start=1):
        source = cut(bench, hall, f"store_from_{start_s:g}", start_s, length_s(hall)) if start_s > 0.0 else hall
        calm = bench.fly(source, f"store_calm{seed}")
        killed = _killed(bench, source, seed)
        pairs.append((killed.ate_m(), calm.ate_m()))
        first = first or killed
    assert first is not None
    name = "final ATE of killed flights over that of undisturbed ones, by start"
    return [*_completeness_bars(bench, first), median_ratio(bench, name, pairs, 1.1)]


def _killed(bench: Bench, source: Path, seed: int) -> FlownProcesses:
    """A flight in which the base is killed at random instants."""
    random = np.random.default_rng(seed)
    at_s = np.sort(random.uniform(_FIRST_S, 0.97 * length_s(source), _DEATHS))
    deaths = tuple(zip(at_s.tolist(), random.uniform(0.0, _DELAY_S, _DEATHS).tolist()))
    store = _store(bench, f"store_of_killed{seed}")
    return bench.fly(source, f"store_killed{seed}", store=str(store), base_kills=deaths)


def _completeness_bars(bench: Bench, killed: FlownProcesses) -> list[Bar]:
    """Whether the first killed flight lost anything."""
    restored = killed.outcome.restored
    faults = [fault for each in restored for fault in each["faults"]]
    made, base = killed.agent()["keyframes"], killed.base
    last = restore(
        Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1), shipped_vocabulary()),
        read(bench.folder / "store_of_killed1"), 0,
    )  # fmt: skip
    return [
        is_true(f"kill -9 at {_DEATHS} random instants of one flight: consistency check after each restart", "passes",
                len(restored) == _DEATHS and not faults, f"{len(restored)} restarts, {len(faults)} faults"),
        is_true("its keyframes, in the map and in the store", "all",
                base["keyframes"] == made == last.keyframes and not last.faults,
                f"{base['keyframes']} and {last.keyframes} of {made}"),
        is_true("its digests at the end", "equal", base["digest_equal"] is True),
    ]  # fmt: skip


def _hall(bench: Bench) -> Path:
    """A flight through the hall; the one of the mapper's bars, where it has been rendered."""
    rendered = bench.folder / "hall-1.mcap"
    return rendered if rendered.exists() else rendered_paths(bench, "store_hall", "hall", ["MH_03_medium.txt"])[0]


def _yesterday(bench: Bench) -> list[Bar]:
    """Part of a flight, all is stopped, and the rest with the same store, by another start of agent and base."""
    whole = Path(bench.source("room_flight.mcap"))
    end_s, store = length_s(whole), str(_store(bench, "store_of_days"))
    days = ((0.0, 0.6 * end_s), (0.4 * end_s, end_s))
    flown = [bench.fly(cut(bench, whole, f"day{day}", *span), f"store_day{day}", store=store)
             for day, span in enumerate(days)]  # fmt: skip
    base = flown[1].base
    return [
        is_true("flown against yesterday's map: one map of both days", "merged", base["merges"] >= 1,
                f"{base['merges']} merges, {base['keyframes']} keyframes"),
        at_most("the second day's ATE base", flown[1].ate_m(), 0.02, "m", 4),
    ]  # fmt: skip


def _cost(bench: Bench) -> list[Bar]:
    """The mapper's step with and without a store."""
    room = bench.source("room_flight.mcap")
    without = bench.fly(room, "store_without").base
    with_store = bench.fly(room, "store_with", store=str(_store(bench, "store_of_room"))).base
    step_ms = [base["timing"]["step_ms"]["p95"] for base in (with_store, without)]
    size_kb = (bench.folder / "store_of_room" / "map.sqlite").stat().st_size / 1000.0
    bench.more.append(
        f"`room_flight` takes {size_kb:.0f} kB on disk, {size_kb / with_store['keyframes']:.1f} kB a keyframe."
    )
    return [at_most("CPU of a step, p95, that a store adds", step_ms[0] - step_ms[1], 1.0, "ms", 2)]

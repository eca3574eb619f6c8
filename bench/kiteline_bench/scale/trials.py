"""Trials that need a process of their own, because their memory is measured: a large map, and a long day.

`python -m kiteline_bench.scale.trials map|day …` prints the outcome as JSON.
"""

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.merging.map_merger import MapMerger
from kiteline_basestation.runtime.warm import warm, warm_graphs
from kiteline_basestation.runtime.worker import LockstepJobs, Workers
from kiteline_basestation.station import Station, StationOutput
from kiteline_bench.harness.bars import environment
from kiteline_bench.scale.copies import PlaceCopies
from kiteline_bench.scale.recorded import Link, Name, RecordedFlight, mask_of, record_flight, renamed, rounds
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import LivePose, Record
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId, SubmapId
from kiteline_hw.system.memory import return_large_arrays, rss_mib
from kiteline_hw.system.vocabulary import shipped_vocabulary

_MODULE = "kiteline_bench.scale.trials"
STEP_NS = 50_000_000
_KEYFRAME_NS = 1_000_000_000
PLACE_M = 40.0  # between two places of a large map
ERROR = np.array([0.06, 0.0, 0.0, 0.0, 0.0, 0.0004])  # of an agent between two places: 0.15 %, and a slow turn
_WORKER_S = 0.5  # that the worker may still take for the last keyframe's jobs
_LAST = 600  # keyframes over which steps are judged
_SETTLING = 40  # steps in which the worker has time for its last jobs


def start(trial: str, source: str, *options: str, say: Callable[[str], None]) -> Any:
    """Run a trial of this module in a process of its own and return its outcome; see `run_trial`."""
    return run_trial(_MODULE, [trial, source, *options], say)


def run_trial(module: str, arguments: Sequence[str], say: Callable[[str], None]) -> Any:
    """The outcome of a module that prints it as JSON in its last line; what it prints before is said.

    Raises RuntimeError with the end of its stderr.
    """
    last = ""
    with tempfile.TemporaryFile("w+") as wrong, subprocess.Popen(
        [sys.executable, "-m", module, *arguments], env=environment(), stdout=subprocess.PIPE, stderr=wrong, text=True
    ) as process:  # fmt: skip
        assert process.stdout is not None
        for line in process.stdout:
            last = line
            if not line.startswith(("{", "[")):
                say(line.rstrip())
        if process.wait():
            wrong.seek(0)
            raise RuntimeError(f"{module} {' '.join(arguments)}: {wrong.read()[-600:]}")
    return json.loads(last)


def empty_station() -> Station:
    """A base without a map, whose channels are real ones."""
    return Station(BaseConfig(), lambda agent: coded_channel(1, 0, "wifi", peer=agent), shipped_vocabulary())


# a large map


@dataclass(slots=True)
class LargeMap:
    """keyframes, rss_mib: at each sample. step_ms, most_ms: mean and largest CPU of the steps of a keyframe. last_ms:
    of each step with the last keyframes before the loop. loop_s: from the recognition of the first place until pose
    graph and bundle are applied, and the longest step meanwhile. error_m: of the last place before that and after.
    """

    keyframes: list[int]
    rss_mib: list[float]
    step_ms: list[float]
    most_ms: list[float]
    last_ms: list[float]
    loops: int = 0
    loop_s: float = float("inf")
    loop_step_ms: float = 0.0
    error_m: tuple[float, float] = (float("inf"), float("inf"))
    built_s: float = 0.0

    def sample(self, keyframes: int) -> None:
        """Note the memory of the process with so many keyframes."""
        self.keyframes.append(keyframes)
        self.rss_mib.append(rss_mib())


class _Flown:
    """A station that one agent's records reach, and the jobs that it starts, on the modelled or on the real clock."""

    def __init__(self, station: Station, link: Link, worker: Workers) -> None:
        self.station, self.link, self.worker = station, link, worker
        self.now_ns = 0
        self.step_ms: list[float] = []
        self.begin_s = time.monotonic()

    def step(self, records: Sequence[Record]) -> StationOutput:
        """One step; jobs that are done by now are taken in."""
        up = self.link.exchange(records, self.now_ns)
        done = self.worker.done(self.now_ns)
        begin_ns = time.process_time_ns()
        output = self.station.step({self.link.agent: up}, done, self.now_ns)
        self.step_ms.append((time.process_time_ns() - begin_ns) / 1e6)
        self.worker.add(output.jobs, self.now_ns)
        self.link.down = dict(output.packets).get(self.link.agent, ())
        self.now_ns += STEP_NS
        return output


def large_map(flight: RecordedFlight, keyframes: int, flown_last: int | None = None) -> LargeMap:
    """Fly through so many keyframes in one submap, back to where it began, until the loop is closed.

    flown_last: without the first place, only so many are flown; all between are copies of the first place.
    """
    station, worker = empty_station(), Workers()
    flown = _Flown(station, Link(AgentId(0), coded_channel(agent_session(1, 0), 0, "wifi", bounded=True)), worker)
    n = len(flight.keyframes)
    places = max(3, round(keyframes / n))
    boundary = (places - 1) * n  # the next keyframe is the first one's place again
    begin, end = Name(AgentId(0), 0, 0, mask_of(0)), Name(AgentId(0), 0, boundary, mask_of(0))
    copied = 0 if flown_last is None else max(0, places - 2 - round(flown_last / n))
    given = rounds(flight, AgentId(0), 0, places, _around(places), se3.exp(ERROR))
    found = LargeMap([], [], [], [], [])
    merger = station.mapper.merger
    assert merger is not None
    count = edges = 0
    loop_begin_s: float | None = None
    try:
        for group in given:
            if count == n and copied:
                count = _copy_places(flown, begin, copied, [group, *itertools.islice(given, n - 1)], given, found)
                continue
            _fly_keyframe(flown, [*(() if count else map_all(flight.about, begin)), *group])
            count += 1
            found.step_ms.append(float(np.mean(flown.step_ms)))
            found.most_ms.append(max(flown.step_ms))
            if boundary - _LAST < count <= boundary:
                found.last_ms += flown.step_ms
            if count % 100 == 0 or count == boundary:
                found.sample(count)
                _tell(count, flown.begin_s)
            if any(e.new >= end.keyframe(0) and e.old < begin.keyframe(n) for e in merger.edges[edges:]):
                loop_begin_s = time.monotonic()
                break
            edges = len(merger.edges)
        found.built_s = time.monotonic() - flown.begin_s
        found.loops = int(loop_begin_s is not None)
        if loop_begin_s is not None:
            before_m = _error_m(station, begin, end, count - boundary)
            _close_loop(flown, merger, begin.submap, loop_begin_s, found)
            found.error_m = before_m, _error_m(station, begin, end, count - boundary)
    finally:
        worker.close()
    return found


def _around(places: int) -> F64:
    """Positions (places,3) on a circle, PLACE_M from one to the next; the last one is the first."""
    angle = 2.0 * np.pi * np.arange(places) / (places - 1)
    radius = PLACE_M * (places - 1) / (2.0 * np.pi)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(places)])


def _copy_places(
    flown: _Flown, of: Name, copies: int, here: Sequence[Sequence[Record]], given: Iterator[Sequence[Record]],
    found: LargeMap,
) -> int:  # fmt: skip
    """Add copies of the place `of`, which was flown; how many keyframes the map has then.

    here: the agent's records of the first copy; those of the others are taken from `given`.
    """
    n = len(here)
    for _ in range(_SETTLING):
        flown.step(())
        time.sleep(0.05)
    places = PlaceCopies(flown.station, flown.link, of)
    for number in range(1, copies + 1):
        flown.now_ns = places.add(Name(of.agent, 0, number * n, mask_of(number)), here, flown.now_ns)
        found.sample((number + 1) * n)
        found.step_ms += [0.0] * n
        found.most_ms += [0.0] * n
        if number % 20 == 0:
            _tell((number + 1) * n, flown.begin_s)
        here = list(itertools.islice(given, n)) if number < copies else []
    places.finish()
    return (copies + 1) * n


def _fly_keyframe(flown: _Flown, records: Sequence[Record]) -> None:
    """The steps of one keyframe: the worker keeps up, as at one keyframe a second."""
    flown.step_ms.clear()
    flown.step(records)
    deadline_s = time.monotonic() + _WORKER_S
    while not flown.worker.idle and time.monotonic() < deadline_s:
        time.sleep(0.002)
    for _ in range(3):  # takes the result of the last keyframe's bundle, and begins this one's
        flown.step(())


def _close_loop(flown: _Flown, merger: MapMerger, map_id: SubmapId, begin_s: float, found: LargeMap) -> None:
    """Step until pose graph and bundle of a loop are applied, or two minutes have passed since `begin_s`."""
    flown.step_ms.clear()
    while time.monotonic() < begin_s + 120.0:
        flown.step(())
        if not merger.is_busy(map_id):
            found.loop_s = time.monotonic() - begin_s
            break
        time.sleep(0.005)
    found.loop_step_ms = max(flown.step_ms)


def _tell(keyframes: int, begin_s: float) -> None:
    print(f"{keyframes} keyframes after {time.monotonic() - begin_s:.0f} s, {rss_mib():.0f} MiB", flush=True)


def _error_m(station: Station, begin: Name, end: Name, count: int) -> float:
    """Mean distance between the keyframes of the first place and those of the last one, which is the same place."""
    sparse_map = station.mapper.map
    ends = ([sparse_map.rows[name.keyframe(k)] for k in range(count)] for name in (begin, end))
    first, last = (sparse_map.keyframes.T_w_k[rows, :3, 3] for rows in ends)
    return float(np.linalg.norm(last - first, axis=1).mean())


# a long day


@dataclass(slots=True)
class Day:
    """rss_mib: after each flight and the silence behind it. flights: how many. keyframes: used in all."""

    rss_mib: list[float]
    flights: int
    keyframes: int


def day(flight: RecordedFlight, hours: float, flights: int) -> Day:
    """Hours of silence with flights in between; each is deleted when the next one has landed."""
    station, jobs = empty_station(), LockstepJobs()
    found = Day([], 0, 0)
    hour_ns = 3_600_000_000_000
    now_ns = 0
    gap_ns = round(hours * hour_ns / flights)
    deleted = 0
    for number in range(flights):
        agent = AgentId(number % 4)
        name = Name(agent, number, 0, mask_of(number + 1))
        link = Link(agent, coded_channel(agent_session(number + 1, number), 0, "wifi"))
        begin_ns = now_ns
        orders: list[Command] = []
        groups = [(*(renamed(r, name) for r in flight.about), *map_all(flight.keyframes[0], name))]
        groups += [map_all(group, name) for group in flight.keyframes[1:]]
        for group in groups:
            done: tuple[JobDone, ...] = ()
            for k in range(_KEYFRAME_NS // STEP_NS):
                records: list[Record] = list(group) if k == 0 else []
                records.append(LivePose(agent, now_ns, name.keyframe(0), np.eye(4), 100))
                up = link.exchange(records, now_ns)
                done = jobs.done(now_ns)
                output = station.step({agent: up}, done, now_ns, orders)
                orders = []
                jobs.add(output.jobs, now_ns)
                link.down = dict(output.packets).get(agent, ())
                now_ns += STEP_NS
        found.flights += 1
        found.keyframes += len(groups)
        if number:
            text = json.dumps({"map": f"{(number - 1) % 4}.{number - 1}.0"})
            orders.append(Command(number, "delete", text))
        while now_ns < begin_ns + gap_ns:  # silence: the base steps on
            output = station.step({}, jobs.done(now_ns), now_ns, orders)
            for answer in output.answers:
                deleted += answer.ok
            orders = []
            jobs.add(output.jobs, now_ns)
            now_ns += 20 * STEP_NS
        found.rss_mib.append(rss_mib())
        print(f"flight {number + 1} of {flights}: {found.rss_mib[-1]:.1f} MiB", flush=True)
    if deleted != flights - 1:
        raise RuntimeError(f"{deleted} maps deleted, expected {flights - 1}")
    return found


def map_all(group: Sequence[Record], name: Name) -> tuple[Record, ...]:
    """Records of a recorded flight under another name."""
    return tuple(renamed(record, name) for record in group)


def main(argv: list[str] | None = None) -> int:
    """Run one trial and print its outcome."""
    p = argparse.ArgumentParser(description="Trials of size that need a process of their own.")
    p.add_argument("trial", choices=("map", "day"))
    p.add_argument("source")
    p.add_argument("--keyframes", type=int, default=2000)
    p.add_argument("--flown", type=int, help="of `map`: keyframes at the end that are flown, where others are copies")
    p.add_argument("--hours", type=float, default=24.0)
    p.add_argument("--flights", type=int, default=24)
    p.add_argument("--recorded", type=int, default=60, help="keyframes of the recorded flight")
    a = p.parse_args(argv)
    cv2.setNumThreads(1)
    return_large_arrays()
    flight = record_flight(a.source, a.recorded)
    codec_warm.warm()
    warm(BaseConfig())
    warm_graphs()
    mapped = a.trial == "map"
    outcome = large_map(flight, a.keyframes, a.flown) if mapped else day(flight, a.hours, a.flights)
    print(json.dumps(asdict(outcome)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

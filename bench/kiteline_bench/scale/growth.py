"""What a step costs in a map of growing size. Most of the map are copies of a place that was flown and mapped.

`python -m kiteline_bench.scale.growth SOURCE SIZE…` prints the outcome as JSON, from a process of its own: its memory
is measured.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import cv2
import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.runtime.warm import warm, warm_graphs
from kiteline_basestation.runtime.worker import LockstepJobs
from kiteline_basestation.station import Station
from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_bench.scale.copies import PlaceCopies
from kiteline_bench.scale.recorded import Link, Name, RecordedFlight, mask_of, record_flight, rounds
from kiteline_bench.scale.trials import ERROR, PLACE_M, STEP_NS, empty_station, map_all, run_trial
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import Record
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_hw.system.memory import return_large_arrays, rss_mib

_AGENT = AgentId(0)
_STEPS = 4  # a keyframe
_SIZES = (1000, 6000, 20_000)
_SOURCE = "room_flight.mcap"
_FLOWN = 30  # keyframes that are measured at each size
_BEFORE = 15  # of the same place, flown before them: the first ones have few neighbours
_SAID = 20  # copies between two words of progress


@dataclass(slots=True)
class Growth:
    """A map. step_ms, keyframe_ms: CPU of the steps with the keyframes that were flown in it, and of those that take a
    new one in. rss_mib: resident memory of the process. cpu_s: that it took so far.
    """

    keyframes: int
    step_ms: list[float]
    keyframe_ms: list[float]
    rss_mib: float
    cpu_s: float


class _Flown:
    """A station in modelled time, and one agent."""

    def __init__(self) -> None:
        self.station: Station = empty_station()
        self._jobs = LockstepJobs()
        self.link = Link(_AGENT, coded_channel(agent_session(1, 0), 0, "wifi", bounded=True))
        self.now_ns = 0

    def fly(self, groups: Sequence[Sequence[Record]]) -> list[float]:
        """Take keyframes in, each with a few steps. Returns the CPU time of each step in ms."""
        out = []
        for group in groups:
            for k in range(_STEPS):
                up = self.link.exchange(group if k == 0 else (), self.now_ns)
                done = self._jobs.done(self.now_ns)
                begin_ns = time.process_time_ns()
                output = self.station.step({_AGENT: up}, done, self.now_ns)
                out.append((time.process_time_ns() - begin_ns) / 1e6)
                self._jobs.add(output.jobs, self.now_ns)
                self.link.down = dict(output.packets).get(_AGENT, ())
                self.now_ns += STEP_NS
        return out


def grow(flight: RecordedFlight, sizes: Sequence[int]) -> list[Growth]:
    """One map that reaches about each of `sizes`, in which a place is flown each time. Says how far it is."""
    n = len(flight.keyframes)
    places = round(sizes[-1] / n) + len(sizes) + 2
    flown, found = _Flown(), list[Growth]()
    mapper = flown.station.mapper
    along = np.column_stack([PLACE_M * np.arange(places), np.zeros((places, 2))])
    given = rounds(flight, _AGENT, 0, places, along, se3.exp(ERROR))
    flown.fly([map_all(flight.about, _place(0, n)), *(next(given) for _ in range(n))])
    flown.fly([()] * 20)  # until the last bundles are applied
    copies, number = PlaceCopies(flown.station, flown.link, _place(0, n)), 1
    for size in sizes:
        while len(mapper.map) + n < size:
            flown.now_ns = copies.add(_place(number, n), [next(given) for _ in range(n)], flown.now_ns)
            number += 1
            if number % _SAID == 0:
                print(
                    f"{len(mapper.map)} keyframes, {rss_mib():.0f} MiB, {time.process_time():.0f} s of CPU", flush=True
                )
        copies.finish()
        place = [next(given) for _ in range(n)]
        number += 1
        flown.fly(place[:_BEFORE])
        step_ms = flown.fly(place[_BEFORE : _BEFORE + _FLOWN])
        found.append(Growth(len(mapper.map), step_ms, step_ms[::_STEPS], rss_mib(), time.process_time()))
        print(f"{found[-1].keyframes} keyframes: a step takes {np.mean(step_ms):.1f} ms", flush=True)
        flown.fly(place[_BEFORE + _FLOWN :])
    return found


def _place(number: int, size: int) -> Name:
    return Name(_AGENT, 0, number * size, mask_of(number))


def run(bench: Bench) -> list[Bar]:
    """Steps in maps of 1,000 to 20,000 keyframes: what grows with the map shows."""
    sizes = [str(size) for size in _SIZES]
    found = run_trial("kiteline_bench.scale.growth", [bench.source(_SOURCE), *sizes], bench.say)
    maps = [Growth(**one) for one in found]
    lines = ["| keyframes | step, mean | p95 | step with a keyframe, mean | memory of the process | CPU so far |",
             "|---|---|---|---|---|---|"]  # fmt: skip
    lines += [
        f"| {m.keyframes} | {np.mean(m.step_ms):.1f} ms | {np.percentile(m.step_ms, 95):.1f} ms "
        f"| {np.mean(m.keyframe_ms):.1f} ms | {m.rss_mib:.0f} MiB | {m.cpu_s:.0f} s |"
        for m in maps
    ]
    about = (
        f"CPU of {_FLOWN} keyframes that are flown at each size, with {_STEPS} steps each. All others but those of the "
        "first place are copies of it, with what base and agent wrote, but without scans."
    )
    bench.more.append("\n".join([*lines, "", about]))
    least, most = maps[0], maps[-1]
    ratio = float(np.mean(most.keyframe_ms) / np.mean(least.keyframe_ms))
    kb = (most.rss_mib - least.rss_mib) * 2**20 / 1000.0 / (most.keyframes - least.keyframes)
    return [
        at_most(f"CPU of a step with a keyframe at {most.keyframes} over that at {least.keyframes}", ratio, 1.5, "", 2),
        at_most(f"a map of {most.keyframes} keyframes: CPU of a step, p95", float(np.percentile(most.step_ms, 95)),
                20.0, "ms", 1),
        at_most("memory of the process for each keyframe, without scans", kb, 57.0, "kB", 1),
    ]  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Grow a map and print what steps in it took."""
    p = argparse.ArgumentParser(description="Steps of the base in a map of growing size.")
    p.add_argument("source")
    p.add_argument("sizes", type=int, nargs="+")
    a = p.parse_args(argv)
    cv2.setNumThreads(1)
    return_large_arrays()
    flight = record_flight(a.source, 60)
    codec_warm.warm()
    warm(BaseConfig())
    warm_graphs()
    print(json.dumps([asdict(one) for one in grow(flight, a.sizes)]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""What a step costs in maps of growing size. Most of each map is restored from copies of a place that was mapped.

`python -m kiteline_bench.scale.growth SOURCE SIZE` prints the outcome as JSON, from a process of its own: its memory is
measured.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.runtime.warm import warm, warm_graphs
from kiteline_basestation.runtime.worker import LockstepJobs
from kiteline_basestation.station import Station
from kiteline_bench.harness.bars import Bar, Bench, at_most, run_command
from kiteline_bench.scale.recorded import Name, RecordedFlight, mask_of, record_flight, rounds
from kiteline_bench.scale.trials import ERROR, PLACE_M, STEP_NS, Link, empty_station, map_all
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import CodedChannel, coded_channel
from kiteline_codec.schema import (
    FusedLandmarks,
    KeyframePose,
    KeyframeScan,
    Record,
    RefinedLandmarks,
    RemovedObservations,
    messages,
)
from kiteline_core.geometry import se3
from kiteline_core.ids import KEYPOINT_BITS, AgentId, KeyframeId
from kiteline_hw.system.memory import return_large_arrays, rss_mib

_AGENT = AgentId(0)
_STEPS = 4  # a keyframe
_OWN = (KeyframePose, RefinedLandmarks, FusedLandmarks, RemovedObservations)
_SIZES = (1000, 6000, 20_000)
_SOURCE = "room_flight.mcap"
_FLOWN = 30  # keyframes that are flown in each map


@dataclass(slots=True)
class Growth:
    """A map. step_ms, keyframe_ms: CPU of the steps with the keyframes that were flown in it, and of those that take a
    new one in. kb: resident memory of map and place index a keyframe.
    """

    keyframes: int
    step_ms: list[float]
    keyframe_ms: list[float]
    kb: float


class _Flown:
    """A station in modelled time, and one agent."""

    def __init__(self) -> None:
        self.station: Station = empty_station()
        self._jobs = LockstepJobs()
        self._link = Link(_AGENT, coded_channel(1, 0, "wifi", bounded=True))
        self.now_ns = 0

    def fly(self, groups: Sequence[Sequence[Record]]) -> list[float]:
        """Take keyframes in, each with a few steps. Returns the CPU time of each step in ms."""
        out = []
        for group in groups:
            for k in range(_STEPS):
                up = self._link.exchange(group if k == 0 else (), self.now_ns)
                done = self._jobs.done(self.now_ns)
                begin_ns = time.process_time_ns()
                output = self.station.step({_AGENT: up}, done, self.now_ns)
                out.append((time.process_time_ns() - begin_ns) / 1e6)
                self._jobs.add(output.jobs, self.now_ns)
                self._link.down = dict(output.packets).get(_AGENT, ())
                self.now_ns += STEP_NS
        return out


def _place(number: int, size: int) -> Name:
    return Name(_AGENT, 0, number * size, mask_of(number))


def _moved(own: Sequence[Record], name: Name, of: Name, shift: np.ndarray) -> list[Record]:
    """What the base wrote of a place, for a copy of it that lies elsewhere by (4,4)."""
    far = name.keyframe(0) - of.keyframe(0)
    out: list[Record] = []
    for record in own:
        held: Any = record
        changed: dict[str, object] = {"keyframe": KeyframeId(held.keyframe + far)}
        if isinstance(record, KeyframePose):
            changed["T_m_k"] = shift @ record.T_m_k
        elif isinstance(record, FusedLandmarks):
            changed["point"] = record.point + (far << KEYPOINT_BITS)
        out.append(replace(held, **changed))
    return out


def grow(flight: RecordedFlight, size: int) -> Growth:
    """A map of about `size` keyframes, in which a place is flown."""
    n = len(flight.keyframes)
    copies = max(1, round(size / n))
    flown = _Flown()
    mapper = flown.station.mapper
    along = np.column_stack([PLACE_M * np.arange(copies + 2), np.zeros((copies + 2, 2))])
    groups = list(rounds(flight, _AGENT, 0, 1, along[:1], se3.exp(ERROR)))
    flown.fly([map_all(flight.about, _place(0, n)), *groups])
    flown.fly([()] * 20)  # until the last bundles are applied
    channel = flown.station.channels[_AGENT]
    assert isinstance(channel, CodedChannel)
    codes = channel.endpoint.own_values().items()
    own = [r for r in (messages.decode(key, code) for key, code in codes) if isinstance(r, _OWN)]
    state, begin_mib, begin = mapper.state(), rss_mib(), len(mapper.map)
    origin = mapper.map.pose(_place(0, n).keyframe(0))
    assert origin is not None
    given = rounds(flight, _AGENT, 0, copies + 2, along, se3.exp(ERROR))
    for _ in range(n):
        next(given)
    for number in range(1, copies):
        received = tuple(r for _ in range(n) for r in next(given) if not isinstance(r, KeyframeScan))
        mapper.restore(_AGENT, received, (), flown.now_ns)
        name = _place(number, n)
        first = mapper.map.pose(name.keyframe(0))
        assert first is not None
        shift = first @ se3.inverse(origin)
        mapper.restore(_AGENT, (), tuple(_moved(own, name, _place(0, n), shift)), flown.now_ns)
    mapper.restore_state(state)
    kb = (rss_mib() - begin_mib) * 2**20 / 1000.0 / max(1, len(mapper.map) - begin)
    flown.fly([next(given) for _ in range(_FLOWN // 2)])  # of a new place: the first ones have few neighbours
    step_ms = flown.fly([next(given) for _ in range(_FLOWN)])
    return Growth(len(mapper.map), step_ms, step_ms[::_STEPS], kb)


def run(bench: Bench) -> list[Bar]:
    """Steps in maps of 1,000 to 20,000 keyframes: what grows with the map shows."""
    maps = []
    for size in _SIZES:
        bench.say(f"a map of {size} keyframes")
        maps.append(_started(bench.source(_SOURCE), size))
    lines = ["| keyframes | step, mean | p95 | step with a keyframe, mean | map and place index a keyframe |",
             "|---|---|---|---|---|"]  # fmt: skip
    lines += [
        f"| {m.keyframes} | {np.mean(m.step_ms):.1f} ms | {np.percentile(m.step_ms, 95):.1f} ms "
        f"| {np.mean(m.keyframe_ms):.1f} ms | {m.kb:.1f} kB |"
        for m in maps
    ]
    bench.more.append("\n".join([*lines, "", f"CPU of {_FLOWN} keyframes that are flown, with {_STEPS} steps each."]))
    least, most = maps[0], maps[-1]
    ratio = float(np.mean(most.keyframe_ms) / np.mean(least.keyframe_ms))
    return [
        at_most(f"CPU of a step with a keyframe at {most.keyframes} over that at {least.keyframes}", ratio, 1.5, "", 2),
        at_most(f"map and place index of {most.keyframes} keyframes, each", most.kb, 45.0, "kB", 1),
    ]


def _started(source: str, size: int) -> Growth:
    done = run_command([sys.executable, "-m", "kiteline_bench.scale.growth", source, str(size)], 3600.0)
    if done.returncode:
        raise RuntimeError(f"growth {source} {size}: {done.stderr[-600:]}")
    return Growth(**json.loads(done.stdout.splitlines()[-1]))


def main(argv: list[str] | None = None) -> int:
    """Grow one map and print what steps in it took."""
    p = argparse.ArgumentParser(description="Steps of the base in a map of a given size.")
    p.add_argument("source")
    p.add_argument("size", type=int)
    a = p.parse_args(argv)
    cv2.setNumThreads(1)
    return_large_arrays()
    flight = record_flight(a.source, 60)
    codec_warm.warm()
    warm(BaseConfig())
    warm_graphs()
    print(json.dumps(asdict(grow(flight, a.size))))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

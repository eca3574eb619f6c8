"""Where the memory of a base goes: run a base again from its log, and measure it and its parts as the map grows.

    python -m kiteline_bench.base.memory FOLDER/base/log.mcap [--every KEYFRAMES] [--trace]

prints a table of what each further keyframe takes. The process that measures does nothing else, since what it compiles
or leaves behind would be counted; kernels have to be compiled before.
"""

import argparse
import gc
import json
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, ModuleType

import cv2
import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.runtime.base_runtime import load_vocabulary
from kiteline_basestation.runtime.warm import warm, warm_graphs
from kiteline_basestation.station import Station
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import CodedChannel
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.system.memory import return_large_arrays, rss_mib
from kiteline_lab.replay.replay import replay_base

_EVERY = 50  # keyframes between two samples
_CODE = (type, ModuleType, FunctionType, BuiltinFunctionType)
_SMALLEST_KB = 0.05  # a keyframe: smaller parts are not listed


@dataclass(frozen=True, slots=True)
class Sample:
    """A base at one moment. parts: bytes of what it holds, by name. traced: bytes that Python allocated, 0: unknown."""

    keyframes: int
    rss_bytes: int
    traced: int = 0
    parts: dict[str, int] = field(default_factory=dict)


def bytes_of(root: object, seen: set[int]) -> int:
    """Bytes of an object and of all that it refers to, without code and what is in `seen`; adds them to `seen`."""
    total, open_ = 0, [root]
    while open_:
        item = open_.pop()
        if id(item) in seen or isinstance(item, _CODE):
            continue
        seen.add(id(item))
        total += sys.getsizeof(item)
        if isinstance(item, np.ndarray):
            open_ += [] if item.base is None else [item.base]
        elif not isinstance(item, str | bytes | int | float):
            open_ += gc.get_referents(item)
    return total


def parts_of(station: Station) -> dict[str, int]:
    """Bytes of a station's parts; what several refer to counts for the first."""
    mapper = station.mapper
    ends = [channel.endpoint for channel in station.channels.values() if isinstance(channel, CodedChannel)]
    seen = {id(station), id(mapper), *map(id, ends)}
    bytes_of(mapper.config, seen)
    pieces: list[tuple[str, object]] = [("map: keypoints", mapper.map.keypoints), ("map: keyframes", mapper.map)]
    pieces += [(f"mapper: {name.strip('_')}", value) for name, value in vars(mapper).items()]
    pieces += [(f"codec: {name.strip('_')}", value) for end in ends for name, value in vars(end).items()]
    pieces += [("station", value) for value in vars(station).values()]
    out: dict[str, int] = {}
    for name, piece in pieces:
        out[name] = out.get(name, 0) + bytes_of(piece, seen)
    return out


def measure(log: Path, report: Callable[[Sample], None], every: int = _EVERY, trace: bool = False) -> None:
    """Run a base again from its log; report a sample whenever so many keyframes more have come, and at the end."""
    cv2.setNumThreads(1)
    codec_warm.warm()
    vocabulary = load_vocabulary()
    warm(BaseConfig())
    if vocabulary is not None:
        warm_graphs()
    if trace:
        tracemalloc.start()
    due = every

    def watch(station: Station) -> None:
        nonlocal due
        if len(station.mapper.map) >= due:
            due += every
            report(_sample(station))

    with LogReader(log) as reader:
        station = replay_base(reader, watch=watch).station
    assert station is not None
    report(_sample(station))


def _sample(station: Station) -> Sample:
    rss_bytes = round(rss_mib() * 2**20)  # before the parts are measured, which takes memory itself
    traced = tracemalloc.get_traced_memory()[0] if tracemalloc.is_tracing() else 0
    return Sample(len(station.mapper.map), rss_bytes, traced, parts_of(station))


def measured(log: Path) -> list[Sample]:
    """The samples of `measure`, taken by a process of its own. Raises subprocess.CalledProcessError."""
    command = [sys.executable, "-m", "kiteline_bench.base.memory", str(log), "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
    return [Sample(**json.loads(line)) for line in done.stdout.splitlines()]


def table(samples: Sequence[Sample]) -> str:
    """Markdown: what each further keyframe takes, in kB, from the first sample to the last."""
    first, last = samples[0], samples[-1]
    more = max(1, last.keyframes - first.keyframes)

    def kb(a: int, b: int) -> str:
        return f"{(b - a) / more / 1000.0:.1f} kB"

    growth = {name: last.parts[name] - first.parts.get(name, 0) for name in last.parts}
    named = sorted(
        (name for name in growth if growth[name] >= 1000.0 * _SMALLEST_KB * more), key=lambda name: -growth[name]
    )
    rows = [(name, kb(0, growth[name])) for name in named]
    rows.append(("all parts", kb(sum(first.parts.values()), sum(last.parts.values()))))
    if last.traced:
        rows.append(("all that Python allocated", kb(first.traced, last.traced)))
    rows.append(("resident, jobs done in the same process", kb(first.rss_bytes, last.rss_bytes)))
    head = f"| keyframes {first.keyframes} to {last.keyframes} | for each |\n|---|---|\n"
    return head + "\n".join(f"| {name} | {value} |" for name, value in rows)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table, or with --json one sample a line."""
    p = argparse.ArgumentParser(
        prog="python -m kiteline_bench.base.memory", description="Measure the memory of a base and its parts."
    )
    p.add_argument("log", metavar="LOG", type=Path, help="base/log.mcap of a flight")
    p.add_argument("--every", metavar="N", type=int, default=_EVERY, help="keyframes between two samples")
    p.add_argument("--trace", action="store_true", help="trace what Python allocates, too; three times slower")
    p.add_argument("--json", action="store_true", help=argparse.SUPPRESS)
    a = p.parse_args(argv)
    return_large_arrays()
    samples: list[Sample] = []

    def report(sample: Sample) -> None:
        samples.append(sample)
        if a.json:
            print(json.dumps(asdict(sample)), flush=True)
        else:
            print(f"{sample.keyframes} keyframes: {sample.rss_bytes / 2**20:.1f} MiB", file=sys.stderr)

    measure(a.log, report, a.every, a.trace)
    if not a.json:
        print(table(samples))
    return 0


if __name__ == "__main__":
    sys.exit(main())

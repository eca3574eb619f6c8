"""`kiteline bench [NAME…]`: measure the bars that kiteline promises to keep, and write docs/results.md.

A benchmark is a module with `TITLE` and `run(bench) -> list[Bar]`, entered in BENCHMARKS. One with several parts has
PARTS: by name, the title and the function of each; NAME/PART runs one of them.
"""

import argparse
import importlib
import os
import tempfile
from pathlib import Path

from kiteline_bench.harness.bars import Bench, FlightFailed, Run
from kiteline_bench.harness.results_page import replace_section, section
from kiteline_hw.ports import SourceError

BENCHMARKS = {
    "first-flight": "kiteline_bench.system.first_flight",
    "vehicle": "kiteline_bench.vehicle.vehicle",
    "house": "kiteline_bench.system.house",
    "grid": "kiteline_bench.grid.grid",
    "reality": "kiteline_bench.reality.reality",
    "agent": "kiteline_bench.agent.flights",
    "governor": "kiteline_bench.agent.governor_settings",
    "consistency": "kiteline_bench.agent.consistency",
    "stages": "kiteline_bench.agent.stages",
    "link": "kiteline_bench.link.link",
    "fuzz": "kiteline_bench.trust.fuzz",
    "trust": "kiteline_bench.trust.trust",
    "scale": "kiteline_bench.scale.scale",
    "places": "kiteline_bench.base.places",
    "mapper": "kiteline_bench.base.mapper",
    "papers": "kiteline_bench.papers.papers",
    "map-cache": "kiteline_bench.base.map_cache",
}  # name -> module


def data_folder(sequences: Path | None = None) -> Path:
    """KITELINE_DATA, else ../shared/data, else the user's sequences. Raises SourceError when there is none of them."""
    named = os.environ.get("KITELINE_DATA")
    folder = Path(named) if named else Path("../shared/data")
    if not folder.is_dir() and sequences is not None:
        return sequences
    if not folder.is_dir():
        raise SourceError(f"{folder}: no recordings there; set KITELINE_DATA to the folder that holds them")
    return folder


def parts(name: str) -> list[tuple[str, str, Run]]:
    """Name, title and function of each part of NAME, or of the one part of NAME/PART; empty if there is none."""
    whole, _, part = name.partition("/")
    if whole not in BENCHMARKS:
        return []
    module = importlib.import_module(BENCHMARKS[whole])
    if not hasattr(module, "PARTS"):
        return [] if part else [(name, module.TITLE, module.run)]
    found: dict[str, tuple[str, Run]] = module.PARTS
    return [(f"{whole}/{key}", title, run) for key, (title, run) in found.items() if part in ("", key)]


def _say(text: str) -> None:
    print(text, flush=True)


def main(argv: list[str]) -> int:
    """Run `kiteline bench`; 1 when a bar is not met.

    Raises FlightFailed or SourceError of the first benchmark that could not be measured, after the others.
    """
    p = argparse.ArgumentParser(
        prog="kiteline bench",
        description="Measure what kiteline promises and write docs/results.md. Recordings are looked for in "
        "$KITELINE_DATA, else in ../shared/data.",
    )
    p.add_argument("names", metavar="NAME", nargs="*", help=f"out of: {', '.join(BENCHMARKS)} (default: all), or one "
                   "part of them: NAME/PART; a PART that is unknown lists those there are")  # fmt: skip
    p.add_argument("--results", metavar="F", type=Path, default=Path("docs/results.md"), help="default: %(default)s")
    p.add_argument("--keep", metavar="DIR", type=Path, help="keep the flights in this folder")
    p.add_argument("--starts", metavar="N", type=int, default=0,
                   help="of the benches over several starts or seeds only N, for a quick look")  # fmt: skip
    p.add_argument("--inputs", metavar="N", type=int, default=0, help="of `fuzz`: how many (default: 200,000)")
    p.add_argument(
        "--seconds", metavar="S", type=float, default=0.0, help="of the flood of `trust/stranger` (default: 30)"
    )
    p.add_argument("--data", metavar="DIR", type=Path, help="of `papers/sequences` and `papers/multi-map`: fly "
                   "the sequences of KITTI, EuRoC, TUM and TUM-VI that are in this folder")  # fmt: skip
    p.add_argument(
        "--full", action="store_true", help="of `scale`: the whole size, which takes up to half an hour a part"
    )
    a = p.parse_args(argv)
    chosen: list[tuple[str, str, Run]] = []
    for name in a.names or BENCHMARKS:
        found = parts(name)
        if not found:
            known = [key for key, _, _ in parts(name.partition("/")[0])] or BENCHMARKS
            p.error(f"no benchmark {name!r}; there are: {', '.join(known)}")
        chosen += found
    data = data_folder(a.data)
    if a.keep is not None:
        a.keep.mkdir(parents=True, exist_ok=True)
    all_met, failures = True, list[FlightFailed | SourceError]()
    for name, title, run in chosen:
        with tempfile.TemporaryDirectory(prefix="kiteline-bench-") as scratch:
            bench = Bench(
                data, a.keep or Path(scratch), _say, starts=a.starts, inputs=a.inputs, seconds=a.seconds, full=a.full,
                sequences=a.data,
            )  # fmt: skip
            try:
                bars = run(bench)
            except (FlightFailed, SourceError) as error:
                _say(f"{name}: not measured: {error}")
                failures.append(error)
                continue
        text = section(name, title, bars, bench.more)
        print("\n" + text)
        a.results.parent.mkdir(parents=True, exist_ok=True)
        old = a.results.read_text() if a.results.exists() else ""
        a.results.write_text(replace_section(old, title, text))
        all_met = all_met and all(bar.met for bar in bars)
    if failures:
        raise failures[0]
    print(f"written: {a.results}")
    return 0 if all_met else 1

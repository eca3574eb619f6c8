"""`kiteline bench [NAME…]`: measure the bars that kiteline promises to keep, and write docs/results.md.

A benchmark is a function that takes a Bench and returns its bars; it is entered in BENCHMARKS. The file holds one
section a benchmark: running one replaces its section and leaves the others. A long benchmark has parts, each with a
section of its own, that can be run alone as NAME/PART.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from kiteline_hw.ports import SourceError

BENCHMARKS = {
    "first-flight": "kiteline_bench.system.first_flight",
    "agent": "kiteline_bench.agent.flights",
    "governor": "kiteline_bench.agent.knobs",
    "honest": "kiteline_bench.agent.honest",
    "link": "kiteline_bench.link.link",
    "fuzz": "kiteline_bench.link.fuzz_bench",
    "places": "kiteline_bench.base.places",
    "stages": "kiteline_bench.agent.stages",
    "mapper": "kiteline_bench.base.mapper",
    "window": "kiteline_bench.base.map_cache",
}  # name -> module that has `TITLE` and `run(bench) -> list[Bar]`, or `PARTS`, by name, of both

_HEAD = (
    "# Results\n\nMade by `kiteline bench`; each section says which command made it and on which machine. "
    "A bar that is not met says so.\n"
)


@dataclass(frozen=True, slots=True)
class Bar:
    """One promise. measured: in words, with units."""

    name: str
    wanted: str
    measured: str
    met: bool


def at_most(name: str, value: float, limit: float, unit: str, digits: int = 3) -> Bar:
    """A bar that wants a value no larger than a limit."""
    space = f" {unit}" if unit else ""
    return Bar(name, f"<= {limit:g}{space}", f"{value:.{digits}f}{space}", value <= limit)


def is_true(name: str, wanted: str, met: bool, measured: str = "") -> Bar:
    """A bar that wants something to be so."""
    return Bar(name, wanted, measured or ("yes" if met else "no"), met)


@dataclass(frozen=True, slots=True)
class Bench:
    """Where a benchmark reads and writes. say: tells people how far it is. more: Markdown to stand below the bars."""

    data: Path
    folder: Path
    say: Callable[[str], None]
    more: list[str] = field(default_factory=list)

    def source(self, name: str) -> str:
        """The path of a recording. Raises SourceError when it is not there."""
        path = self.data / name
        if not path.exists():
            raise SourceError(f"{path}: not there; set KITELINE_DATA to the folder that holds the recordings")
        return str(path)


Run = Callable[[Bench], list[Bar]]


def data_folder() -> Path:
    """KITELINE_DATA, else ../shared/data where it exists. Raises SourceError when there is neither."""
    named = os.environ.get("KITELINE_DATA")
    folder = Path(named) if named else Path("../shared/data")
    if not folder.is_dir():
        raise SourceError(f"{folder}: no recordings there; set KITELINE_DATA to the folder that holds them")
    return folder


def machine() -> str:
    """This machine and what it computes with, in one line, without a date."""
    model = platform.machine()
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        model = found.group(1).strip() if found else model
    except OSError:
        pass
    packages = []
    for name in ("numpy", "numba", "cv2"):
        packages.append(f"{name} {importlib.import_module(name).__version__}")
    return f"{model}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}, " + ", ".join(
        packages
    )


def section(name: str, title: str, bars: Sequence[Bar], more: Sequence[str] = ()) -> str:
    """The Markdown of one benchmark."""
    met = sum(bar.met for bar in bars)
    lines = [
        f"## {title}", "", f"`kiteline bench {name}` on {machine()}.", "", f"{met} of {len(bars)} bars met.", "",
        "| bar | wanted | measured | met |", "|---|---|---|---|",
    ]  # fmt: skip
    lines += [f"| {bar.name} | {bar.wanted} | {bar.measured} | {'yes' if bar.met else '**no**'} |" for bar in bars]
    for text in more:
        lines += ["", text]
    return "\n".join(lines) + "\n"


def replace_section(text: str, title: str, new: str) -> str:
    """A results file with one section replaced, or added at the end."""
    pattern = re.compile(rf"^## {re.escape(title)}\n.*?(?=^## |\Z)", re.MULTILINE | re.DOTALL)
    text = text or _HEAD
    if pattern.search(text):
        return pattern.sub(lambda _: new + "\n", text).rstrip() + "\n"
    return text.rstrip() + "\n\n" + new


def parts(name: str) -> list[tuple[str, str, Run]]:
    """Name, title and function of each part of NAME, or of the one part of NAME/PART; nothing where there is none."""
    whole, _, part = name.partition("/")
    if whole not in BENCHMARKS:
        return []
    module = importlib.import_module(BENCHMARKS[whole])
    if not hasattr(module, "PARTS"):
        return [] if part else [(name, module.TITLE, module.run)]
    found: dict[str, tuple[str, Run]] = module.PARTS
    return [(f"{whole}/{key}", title, run) for key, (title, run) in found.items() if part in ("", key)]


def main(argv: list[str]) -> int:
    """Run `kiteline bench`; 1 when a bar is not met."""
    p = argparse.ArgumentParser(
        prog="kiteline bench",
        description="Measure what kiteline promises and write docs/results.md. Recordings are looked for in "
        "$KITELINE_DATA, else in ../shared/data.",
    )
    p.add_argument("names", metavar="NAME", nargs="*", help=f"out of: {', '.join(BENCHMARKS)} (default: all)")
    p.add_argument("--results", metavar="F", type=Path, default=Path("docs/results.md"), help="default: %(default)s")
    p.add_argument("--keep", metavar="DIR", type=Path, help="keep the flights in this folder")
    a = p.parse_args(argv)
    chosen: list[tuple[str, str, Run]] = []
    for name in a.names or BENCHMARKS:
        found = parts(name)
        if not found:
            p.error(f"no benchmark {name!r}; there are: {', '.join(BENCHMARKS)}")
        chosen += found
    data = data_folder()
    if a.keep is not None:
        a.keep.mkdir(parents=True, exist_ok=True)
    good = True
    for name, title, run in chosen:
        with tempfile.TemporaryDirectory(prefix="kiteline-bench-") as scratch:
            bench = Bench(data, a.keep or Path(scratch), lambda text: print(text, flush=True))
            bars = run(bench)
        text = section(name, title, bars, bench.more)
        print("\n" + text)
        a.results.parent.mkdir(parents=True, exist_ok=True)
        old = a.results.read_text() if a.results.exists() else ""
        a.results.write_text(replace_section(old, title, text))
        good = good and all(bar.met for bar in bars)
    print(f"written: {a.results}")
    return 0 if good else 1

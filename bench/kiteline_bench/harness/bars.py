"""Bars that a benchmark measures, and the folder, recordings and flights that it works with."""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from kiteline_bench.harness.result import FlownProcesses
from kiteline_core.errors import KitelineError
from kiteline_hw.ports import SourceError
from kiteline_lab.flights.fly import fly
from kiteline_lab.flights.plan import Options

T = TypeVar("T")


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
    """A bar that wants a condition to hold."""
    return Bar(name, wanted, measured or ("yes" if met else "no"), met)


class FlightFailed(KitelineError):
    """A process of a flight ended on its own."""


@dataclass(frozen=True, slots=True)
class Bench:
    """What a benchmark reads and writes. say: reports progress. more: Markdown that stands below the bars.

    starts: most starts of a flight, or seeds, for a quick look; 0: all. inputs: of the fuzzer, seconds: of a flood; 0:
    as the benchmark chooses.
    full: at the whole size, which takes long. sequences: a folder of data sets that the user has; None without one.
    """

    data: Path
    folder: Path
    say: Callable[[str], None]
    more: list[str] = field(default_factory=list)
    starts: int = 0
    inputs: int = 0
    seconds: float = 0.0
    full: bool = False
    sequences: Path | None = None

    def chosen(self, starts: Sequence[T]) -> list[T]:
        """All starts, or as many as wanted, spread evenly."""
        n = len(starts)
        few = min(self.starts or n, n)
        return [starts[k * n // few] for k in range(few)]

    def source(self, name: str) -> str:
        """The absolute path of a recording: other builds run elsewhere. Raises SourceError when it is not there."""
        path = self.data / name
        if not path.exists():
            raise SourceError(f"{path}: not there; set KITELINE_DATA to the folder that holds the recordings")
        return str(path.resolve())

    def fly(
        self, sources: str | Path | Sequence[str | Path], folder: str, *, shown: bool = False, **options: Any
    ) -> FlownProcesses:
        """Fly as `kiteline fly` does, into a folder of the bench; options: fields of its Options.

        shown: progress by frames. Raises FlightFailed when a process ended on its own.
        """
        several = [sources] if isinstance(sources, str | Path) else sources
        self.say(f"flying {', '.join(Path(source).name for source in several)} ({folder})")
        out = self.folder / folder
        report, outcome = fly(Options(tuple(str(source) for source in several), out, **options), quiet=not shown)
        if outcome.failed:
            raise FlightFailed(f"{folder}: {outcome.notes}")
        return FlownProcesses(out, dict(report), outcome)

    def warm(self) -> None:
        """Compile all kernels, so that flights measure flying."""
        self.say("compiling kernels")
        run_command([sys.executable, "-m", "kiteline_cli", "doctor", "--warm"], 600.0)


Run = Callable[[Bench], list[Bar]]


def table(bench: Bench, title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Show figures of single flights below the bars."""
    lines = [f"{title}:", "", f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    lines += [f"| {' | '.join(_text(value) for value in row)} |" for row in rows]
    bench.more.append("\n".join(lines))


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
    return str(value)


def in_turn(*runs: Run, warm: bool = False) -> Run:
    """A benchmark that runs others in turn."""

    def run(bench: Bench) -> list[Bar]:
        if warm:
            bench.warm()
        return [bar for part in runs for bar in part(bench)]

    return run


def run_command(command: Sequence[str], timeout_s: float, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a command with this process's modules. Raises subprocess.TimeoutExpired."""
    return subprocess.run(
        command, check=False, env=environment(**variables), capture_output=True, text=True, timeout=timeout_s
    )  # fmt: skip


def environment(**variables: str) -> dict[str, str]:
    """Environment of a child process that imports what this one imports."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry), **variables}

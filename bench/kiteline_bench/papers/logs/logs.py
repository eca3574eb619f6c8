"""`kiteline bench papers/logs`: logs over hours of flight, cut anywhere, and replayed."""

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, environment, is_true
from kiteline_bench.papers.logs.cuts import try_cuts, write_log
from kiteline_bench.papers.logs.hours import EARLIER, RATE_HZ, fly_hours
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from kiteline_lab.references.comparison import TOLERANCE, differences, largest
from kiteline_lab.references.flights import FLIGHTS, FOLDER
from kiteline_lab.references.observation import Observation, from_text

TITLE = "Logs: over hours, cut anywhere, replayed"

_HOURS, _CAP_MIB = 3.0, 256
_SMALL_S, _SMALL_BYTES = 5.0, 60  # a log of some 12 kB that is cut at each byte
_LARGE_S, _LARGE_BYTES, _RANDOM_CUTS = 22.0, 40_000, 2000
_CI_S = 60.0
# Kernels for other CPUs, as far as this one can run them.
_OTHER_CPUS: dict[str, dict[str, str]] = {
    "OpenBLAS for Sandy Bridge": {"OPENBLAS_CORETYPE": "Sandybridge"},
    "OpenBLAS for Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "numpy without AVX2": {"NPY_DISABLE_CPU_FEATURES": "X86_V3"},
    "OpenCV without AVX": {"OPENCV_CPU_DISABLE": "AVX2,FP16,AVX"},
    "OpenCV with SSE3 alone": {"OPENCV_CPU_DISABLE": "AVX2,FP16,AVX,SSE4.2,SSE4.1"},
    "OpenCV without IPP": {"OPENCV_IPP": "disabled"},
    "numba for any x86-64": {"NUMBA_CPU_NAME": "generic"},
}


@dataclass(frozen=True, slots=True)
class Spent:
    """Time of a child process: on the wall, and of its CPU, in seconds."""

    wall_s: float
    cpu_s: float


def run(bench: Bench) -> list[Bar]:
    """Measure all."""
    return [*_hours(bench), *_cuts(bench), *_speed(bench), *_kept(bench)]


def _hours(bench: Bench) -> list[Bar]:
    hours = bench.seconds / 3600.0 or _HOURS
    bench.say(f"{hours:g} h of a flight's log at {RATE_HZ} Hz")
    day = fly_hours(bench.folder / "hours", hours, _CAP_MIB)
    cap = _CAP_MIB << 20
    said = [line for line in day.notices if "oldest logs" in line]
    what = f"{hours:g} h at {RATE_HZ} Hz, {day.written_bytes / 1e9:.2f} GB of logs"
    return [
        at_most(f"{what}: most on disk at any of {day.looks} looks, one a second", day.most_bytes / (1 << 20),
                float(_CAP_MIB), "MiB", 1),
        is_true("rotation: the oldest logs go first, those of earlier starts before all", "always",
                day.in_order and day.deleted > EARLIER, f"{day.deleted} deleted, in this order: {day.in_order}"),
        is_true("rotation is said", "once", len(said) == 1, f"{len(said)} times in {hours:g} h"),
        is_true("every part that is left opens alone, with images, calibration and whole steps", "all",
                not day.unreadable and day.parts > 4, f"{day.parts - len(day.unreadable)} of {day.parts} parts"),
        at_most("frames missing between these parts, and at the end", day.gaps, 0.0, "", 0),
        at_most("notes of messages that were not written", day.lost_messages, 0.0, "", 0),
        is_true("what is left is at least half of the limit", f">= {cap / 2**21:.0f} MiB", 2 * day.kept_bytes >= cap,
                f"{day.kept_bytes / 2**20:.0f} MiB"),
    ]  # fmt: skip


def _cuts(bench: Bench) -> list[Bar]:
    folder = bench.folder / "cuts"
    folder.mkdir(parents=True, exist_ok=True)
    small = write_log(folder / "small.mcap", _SMALL_S, _SMALL_BYTES)
    large = write_log(folder / "large.mcap", _LARGE_S, _LARGE_BYTES)
    size = small.path.stat().st_size
    bench.say(f"cutting a log at each of its {size} bytes, and one of 22 s at {_RANDOM_CUTS} of them")
    drawn = np.random.default_rng(6).integers(0, large.path.stat().st_size, _RANDOM_CUTS).tolist()
    bars = []
    for name, log, cuts in (
        (f"each byte of a log of {size / 1e3:.0f} kB", small, list(range(size))),
        (f"{_RANDOM_CUTS} random bytes of one of {large.path.stat().st_size / 1e6:.1f} MB", large, drawn),
    ):
        found = try_cuts(log, folder, cuts)
        bad = found.unreadable + found.wrong + found.short
        bars.append(
            is_true(f"cut at {name}: all that was flushed is read, as written", "always", bad == 0,
                    f"{found.tried} cuts, {found.unreadable} unreadable, {found.wrong} read otherwise, {found.short} "
                    f"short; up to {found.more} messages behind the last flush read, too")
        )  # fmt: skip
    late = max(small.late_s, large.late_s)
    return [*bars, at_most("flight time from a message to its flush", late, 1.0 + 1.0 / RATE_HZ, "s", 2)]


def _speed(bench: Bench) -> list[Bar]:
    """Replay a flight of 22 s on one core."""
    recording = bench.source("room_flight.mcap")
    source = open_source(recording)
    seconds = (source.frame_count or 0) / 20.0
    source.close()
    bench.warm()
    flown = bench.fly(recording, "flight")
    bars = []
    for half in ("agent0", "base"):
        bench.say(f"replaying the log of {half}")
        command = ["-m", "kiteline_cli", "replay", str(flown.folder / half / "log.mcap"), "--verify"]
        spent = [_spend(command) for _ in range(2)]
        wall, cpu = min(s.wall_s for s in spent), min(s.cpu_s for s in spent)
        name = "with images " if half == "agent0" else ""
        bars += [
            is_true(f"replay of {seconds:.0f} s {name}on one core, {half}: speed by its CPU time", ">= 2x real time",
                    seconds >= 2.0 * cpu, f"{seconds / cpu:.1f}x ({cpu:.1f} s, start of the program included)"),
            is_true(f"the same, {half}: by the clock", ">= 2x real time", seconds >= 2.0 * wall,
                    f"{seconds / wall:.1f}x ({wall:.1f} s)"),
        ]  # fmt: skip
    return bars


def _kept(bench: Bench) -> list[Bar]:
    """Replay the kept logs several times, and with kernels for other CPUs."""
    if not FOLDER.is_dir():
        raise SourceError(f"{FOLDER}: not there; run from the folder of kiteline's sources")
    bench.say("replaying the kept logs")
    outs = [bench.folder / f"kept{k}" for k in range(2)]
    spent = [_spend(_replay_into(out), PYTHONHASHSEED=str(k)) for k, out in enumerate(outs)]
    texts = [{flight.name: (out / f"{flight.name}.txt").read_bytes() for flight in FLIGHTS} for out in outs]
    same = sum(texts[0][name] == texts[1][name] for name in texts[0])
    kept = {flight.name: from_text((FOLDER / f"{flight.name}.txt").read_text(encoding="utf-8")) for flight in FLIGHTS}
    bars = [
        is_true("two replays of every kept log are identical", f"all {len(FLIGHTS)}", same == len(FLIGHTS),
                f"{same} of {len(FLIGHTS)} flights, every digit and digest"),
        at_most("CPU of replaying all kept logs, as CI does", min(s.cpu_s for s in spent), _CI_S, "s", 1),
    ]  # fmt: skip
    lines = ["| kernels | flights with equal digests | largest difference, m | rad | counts beyond the tolerance |",
             "|---|---|---|---|---|"]  # fmt: skip
    beyond_all = 0
    for k, (name, variables) in enumerate(_OTHER_CPUS.items()):
        bench.say(f"replaying the kept logs, {name}")
        out = bench.folder / f"other{k}"
        if "NUMBA_CPU_NAME" in variables:
            variables = {**variables, "NUMBA_CACHE_DIR": str(bench.folder / "kernels")}
        _spend(_replay_into(out), **variables)
        found = {name: from_text((out / f"{name}.txt").read_text(encoding="utf-8")) for name in kept}
        equal = sum(not differences(kept[name], found[name], None) for name in kept)
        beyond = sum(len(differences(kept[name], found[name], TOLERANCE)) for name in kept)
        beyond_all += beyond
        far = [_worst(kept, found, unit) for unit in ("m", "rad")]
        lines.append(f"| {name} | {equal} of {len(kept)} | {far[0]:.2g} | {far[1]:.2g} | {beyond} |")
    bench.more.append("Kept logs with kernels for other CPUs, beside the kept text:\n\n" + "\n".join(lines))
    wanted = (
        f"within {1e3 * TOLERANCE.position_m:g} mm, {1e3 * TOLERANCE.angle_rad:g} mrad, {100 * TOLERANCE.counts:g} %"
    )
    bars.append(
        is_true("kept logs with kernels for other CPUs", wanted, beyond_all == 0, f"{beyond_all} values beyond")
    )
    return bars


def _worst(kept: dict[str, Observation], found: dict[str, Observation], unit: str) -> float:
    return max(largest(kept[name], found[name], unit) for name in kept)


def _replay_into(out: Path) -> list[str]:
    return ["-m", "kiteline_lab.references", "--folder", str(FOLDER), "--out", str(out)]


def _spend(arguments: list[str], **variables: str) -> Spent:
    """Run Python with these arguments on one core. Raises SourceError if it fails."""
    before, begin_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(
        [sys.executable, *arguments], check=False, capture_output=True, text=True, env=environment(**variables),
        preexec_fn=_one_core(),
    )  # fmt: skip
    wall_s, after = time.monotonic() - begin_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SourceError(f"{' '.join(arguments)}: {(done.stderr or done.stdout).strip()[-300:]}")
    return Spent(wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def _one_core() -> Callable[[], None]:
    core = max(os.sched_getaffinity(0))
    return lambda: os.sched_setaffinity(0, {core})

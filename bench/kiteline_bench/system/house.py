"""The bars of the sources themselves: structure, CPU beside an older build, compilation, time of the tests."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from statistics import median
from typing import Any

from kiteline_agent.runtime.warm import WARMING as agent_modules
from kiteline_basestation.runtime.warm import WARMING as base_modules
from kiteline_bench.harness.bars import Bar, Bench, at_most, environment, is_true
from kiteline_bench.reality.cpu import yardstick_ms
from kiteline_bench.system.compile_time import measure, waiting_s
from kiteline_bench.system.older_build import REVISION, Build, older_build, todays_build
from kiteline_bench.system.structure import ROOT, Sources, by_sub_package, circles

_MODULES, _LINES, _ALL_LINES = 14, 400, 38_000  # in a folder, in a file, in all rooms
_COMPILE_S = 12.0
_SUITE_S = 300.0  # on two cores
_ROUNDS = 5
_CPU_RATIO = 1.02


def _structure(bench: Bench) -> list[Bar]:
    """Sizes of folders and files, import circles, lines of all rooms."""
    sources = Sources.of(ROOT)
    lines, folders, imports = sources.lines(), sources.folder_sizes(), sources.imports()
    (largest_folder, modules), *_ = folders.most_common(1)
    longest = max(lines, key=lambda name: lines[name])
    large_folders = [folder for folder, count in folders.items() if count > _MODULES]
    long_files = [name for name, count in lines.items() if count > _LINES]
    modules_in_circles, packages_in_circles = circles(imports), circles(by_sub_package(imports))
    rooms = {room: sum(n for name, n in lines.items() if name.startswith(f"{room}.") or name == room)
             for room in sorted({name.split(".")[0] for name in lines})}  # fmt: skip
    bench.more.append("Lines: " + ", ".join(f"{room} {count}" for room, count in rooms.items()) + ".")
    for title, groups in (("modules", modules_in_circles), ("sub-packages", packages_in_circles)):
        bench.more.extend(f"Circle of {title}: {', '.join(group)}." for group in groups)
    return [
        is_true("modules in a folder", f"<= {_MODULES}", not large_folders,
                f"{modules} in {largest_folder.removeprefix(f'{ROOT}/')}, {len(large_folders)} folders above"),
        is_true("lines of a file", f"<= {_LINES}", not long_files,
                f"{lines[longest]} in {longest}, {len(long_files)} files above"),
        at_most("import circles of modules, under TYPE_CHECKING too", len(modules_in_circles), 0, "", 0),
        at_most("import circles of sub-packages", len(packages_in_circles), 0, "", 0),
        at_most("lines of all rooms", sum(lines.values()), _ALL_LINES, "", 0),
    ]  # fmt: skip


def _cpu(bench: Bench) -> list[Bar]:
    """CPU of this build over that of an older one, flown in alternation; also without the scans the older one lacks."""
    older, today = older_build(bench), todays_build(bench)
    for build in (older, today):
        bench.say(f"compiling kernels of {build.root.name}")
        build.warm(bench.source("room_flight.mcap"), bench.folder.resolve() / "cpu_warm")
    builds: dict[str, tuple[Build, list[str]]] = {
        "older": (older, []), "today": (today, []), "without scans": (today, ["--grid", "off"]),
    }  # fmt: skip
    bars = []
    for name in ("room_flight.mcap", "kitti_straight"):
        source, rounds = bench.source(name), []
        for k in range(_ROUNDS + 1):  # the first one is not counted
            reports = {}
            for kind in sorted(builds, reverse=bool(k % 2)):
                bench.say(f"flying {name}, round {k}: {kind}")
                build, options = builds[kind]
                reports[kind] = build.fly([source], bench.folder.resolve() / f"cpu_{kind.split()[0]}", *options)
            rounds.append(reports)
        for kind in ("without scans", "today"):
            for half, cpu_ms in (("agent, CPU a frame", _agent_ms), ("base, CPU a step", _base_ms)):
                what = f"{name}: {half}" + (", without scans" if kind == "without scans" else "")
                pairs = [(cpu_ms(reports[kind]), cpu_ms(reports["older"])) for reports in rounds[1:]]
                bench.more.append(f"{what}, ms: " + ", ".join(f"{ours:.2f} / {old:.2f}" for ours, old in pairs) + ".")
                ratio = median(ours / old for ours, old in pairs)
                bars.append(at_most(f"{what}, over that of {REVISION[:8]}, median of {_ROUNDS}", ratio, _CPU_RATIO,
                                    "", 3))  # fmt: skip
    return bars


def _agent_ms(report: dict[str, Any]) -> float:
    return float(report["agents"][0]["timing"]["cpu_ms_per_frame"]["mean"])


def _base_ms(report: dict[str, Any]) -> float:
    return float(report["base"]["timing"]["step_ms"]["mean"])


def _compile(bench: Bench) -> list[Bar]:
    """CPU to compile the kernels of each half from an empty cache; how long a start waits, on one core and on two."""
    bars = []
    for room, modules in (("agent", agent_modules), ("base", base_modules)):
        bench.say(f"compiling the kernels of the {room}")
        found = measure(room)
        slowest = sorted(found.seconds.items(), key=lambda item: -item[1])[:8]
        bench.more.append(f"{room}, slowest: " + ", ".join(f"`{name}` {s:.1f} s" for name, s in slowest) + ".")
        one_s, two_s = (waiting_s(modules, cores) for cores in (1, 2))
        bench.more.append(f"{room}, wait at a cold start: {one_s:.1f} s on one core, {two_s:.1f} s on two.")
        bars.append(at_most(f"compilation of all kernels of the {room}, CPU", found.total_s, _COMPILE_S, "s", 1))
    return bars


def runs_of_make_test(makefile: str) -> list[list[str]]:
    """What `make test` gives pytest after -q, for each of its runs."""
    runs = [line.partition("-m pytest -q ")[2] for line in makefile.splitlines()]
    return [shlex.split(options) for options in runs if options]


def _suite(bench: Bench) -> list[Bar]:
    """Time of all tests, with kernels compiled before, as `make test` runs them. Raises RuntimeError if one fails."""
    bench.warm()
    begin_s, cpu_s = time.monotonic(), _children_s()
    for options in runs_of_make_test((ROOT / "Makefile").read_text(encoding="utf-8")):
        bench.say(f"pytest {' '.join(options)}")
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", *options], check=False, cwd=ROOT, env=environment(),
            capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(f"the tests failed: {done.stdout[-600:]}")
        bench.more.append(f"`-m '{options[-1]}'`: {done.stdout.splitlines()[-1]}.")
    seconds, cpu_s = time.monotonic() - begin_s, _children_s() - cpu_s
    unit_ms = median(yardstick_ms(bench.source("room_flight.mcap")))
    bench.more.append(f"The yardstick of `reality/cpu`, ORB on one core, takes {unit_ms:.1f} ms on this machine.")
    return [
        at_most("all tests", seconds, _SUITE_S, "s", 0),
        at_most("CPU of all tests, on two cores", cpu_s, 2 * _SUITE_S, "s", 0),
    ]


def _children_s() -> float:
    """CPU time of all child processes that have ended."""
    times = os.times()
    return times.children_user + times.children_system


PARTS = {
    "structure": ("Sources: structure", _structure),
    "cpu": ("Sources: CPU beside an older build", _cpu),
    "compile": ("Sources: compilation of kernels", _compile),
    "suite": ("Sources: time of the tests", _suite),
}

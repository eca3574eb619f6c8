"""Throttled flights in real time under the kernel's limit: one computer, or the agent's alone."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from kiteline_bench.harness.bars import Bar, Bench, FlightFailed, environment, is_true
from kiteline_bench.harness.result import FlownProcesses
from kiteline_bench.harness.starts import cut
from kiteline_bench.papers.throttled import MODES, Throttled, outcome
from kiteline_hw.system.cpu import CpuQuota
from kiteline_lab.flights.outcome import FlightOutcome

_PERCENTS = (25.0, 12.5)
_SECONDS = 15.0  # of the recording
_TIMEOUT_S = 600.0  # for a flight whose processes start on an eighth of a core


def run(bench: Bench) -> list[Bar]:
    """A table, where this machine allows limits."""
    reason = CpuQuota.unavailable()
    if reason is None:
        source = cut(bench, Path(bench.source("room_flight.mcap")), "room_in_real_time", 0.0, _SECONDS)
        flights = [fly(bench, source, percent) for percent in _PERCENTS for fly in (_together, _apart)]
        bench.more.append(_table(flights))
    return [is_true("throttled by the kernel, in real time", "where the machine allows it", True, reason or "flown")]


def _together(bench: Bench, source: Path, percent: float) -> Throttled:
    """All processes of a flight under one limit: agent, base and its workers."""
    out = bench.folder / f"kernel-local-{percent:g}"
    out.mkdir(parents=True, exist_ok=True)
    config = out / "limit.toml"
    config.write_text(f"[agent.governor]\ncpu_percent = {percent}\n")
    bench.say(f"flying {source.name} in real time, agent and base on {percent:g} % of a core")
    command = [sys.executable, "-m", "kiteline_cli", "fly", str(source), "--realtime", "--no-imu"]
    with CpuQuota(percent) as quota:
        flight = subprocess.Popen(
            [*command, "--config", str(config), "--out", str(out)],
            env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        quota.add(flight.pid)
        try:
            _, told = flight.communicate(timeout=_TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            flight.terminate()
            flight.wait()
            raise FlightFailed(f"{out.name}: not over after {_TIMEOUT_S:g} s") from error
    if flight.returncode:
        raise FlightFailed(f"{out.name}: {told[-300:]}")
    report = json.loads((out / "report.json").read_text())
    return outcome(FlownProcesses(out, report, FlightOutcome([None])), source, "local", percent)


def _apart(bench: Bench, source: Path, percent: float) -> Throttled:
    """The agent's process under the limit, the base without one."""
    flown = bench.fly(source, f"kernel-distributed-{percent:g}", realtime=True, cpu_percent=percent, imu=False)
    return outcome(flown, source, "distributed", percent)


def _table(flights: Sequence[Throttled]) -> str:
    columns = ("% of a core", "configuration", "max t_abs m", "RMSE t_rel m", "tracking ms", "frames without a pose")
    lines = [
        (
            f"The first {_SECONDS:g} s of room_flight in real time under the kernel's limit, decoding of images "
            "included; this machine's core, whatever it is.\n"
        ),
        f"| {' | '.join(columns)} |",
        "|---" * len(columns) + "|",
    ]
    for f in flights:
        lines.append(
            f"| {f.percent:g} | {MODES[f.mode]} | {f.errors.max_abs_m:.3f} | {f.errors.rmse_rel_m:.4f} "
            f"| {f.tracking_ms:.0f} | {100.0 * f.missing:.0f} % |"
        )
    return "\n".join(lines)

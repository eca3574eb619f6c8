"""Fly the frames of an agent's log anew under a CPU limit: the kernel's where it is allowed, else a modelled core."""

import contextlib
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from kiteline_agent.runtime.options import AgentOptions
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from kiteline_hw.system import kernel_cache, process
from kiteline_hw.system.cpu import CpuQuota
from kiteline_lab.flights.children import ChildProcesses, ended_by
from kiteline_lab.flights.flight_report import statistic
from kiteline_lab.flights.in_process import fly_in_process
from kiteline_lab.flights.plan import FlightPlan, flight_starts
from kiteline_lab.flights.progress import Progress


def refly(log: Path, percent: float, out: Path | None, virtual: bool) -> int:
    """Fly the log's frames with `percent` of a core and print the outcome; the exit status."""
    with LogReader(log) as reader:
        if reader.metadata.get("role") not in ("agent", None):
            raise SourceError(f"{log}: --cpu flies an agent's log anew, this is a {reader.metadata['role']}'s")
    reason = "asked for" if virtual else CpuQuota.unavailable()
    with contextlib.ExitStack() as stack:
        folder = out if out is not None else Path(stack.enter_context(tempfile.TemporaryDirectory()))
        report = _modelled(log, percent, folder) if reason else _limited(log, percent, folder)
    how = f"the modelled core ({reason})" if reason else "the kernel's limit"
    cpu = statistic(report["timing"]["cpu_ms_per_frame"])
    print(
        f"{percent:g} % of a core, {how}: {report['frames']} frames, {report['tracked']} tracked, "
        f"{report['lost']} lost, {report['dropped']} dropped, {cpu['mean']:.1f} ms a frame on this machine"
    )
    process.print_lines([f"note: {note}" for note in report["notes"]])
    return 0


def _modelled(log: Path, percent: float, folder: Path) -> dict[str, Any]:
    source = open_source(f"mcap:{log}")
    with contextlib.closing(source):
        start_ns = flight_starts([source])[0]
        options = AgentOptions(source=f"mcap:{log}", folder=str(folder), start_ns=start_ns, cpu_percent=percent)
        report = fly_in_process(FlightPlan([source], [options], frames=source.frame_count), "tracker").agents[0]
    assert report is not None
    return report


def _limited(log: Path, percent: float, folder: Path) -> dict[str, Any]:
    options = AgentOptions(source=f"mcap:{log}", folder=str(folder), cpu_percent=percent)
    with ChildProcesses() as children, Progress("flying", None, "frames") as progress:
        child = children.start("agent0", "kiteline_agent", asdict(options), folder)
        report: dict[str, Any] | None = None
        error = ""
        while (event := children.next_event(300.0)) is not None and event.kind != "exit":
            if event.kind == "compiling":
                seconds = event.values.get("seconds", 0)
                process.print_lines([kernel_cache.still_compiling(seconds) if seconds else kernel_cache.COMPILING])
            elif event.kind == "progress":
                progress.update(event.values["frames"])
            elif event.kind == "result":
                report = event.values["report"]
            elif event.kind == "error":
                error = event.values["text"]
        if report is None:
            code = event.values["code"] if event is not None else -9
            raise SourceError(f"the agent {ended_by(code)}: {error or child.stderr_tail()}")
    return report

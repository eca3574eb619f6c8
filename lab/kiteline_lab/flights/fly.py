"""`kiteline fly`: agents and a base as separate processes on this machine, or in this one; what they leave is judged.

Plan (open sources, set flight time 0) -> flight (lock-step or live) -> outcome -> trajectories, plot, report, table.
"""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import dataclass, field
from pathlib import Path

from kiteline_agent.runtime.options import AgentOptions
from kiteline_basestation.runtime.options import BaseOptions
from kiteline_core.frame import Frame
from kiteline_hw.logs.mcap_repair import repair
from kiteline_hw.ports import FrameSource, LinkError, SourceError
from kiteline_hw.sources.kinds import source_forms
from kiteline_hw.sources.open import open_source
from kiteline_hw.system import process
from kiteline_lab.flights.flight import Flight, Outcome, fly_here, fly_processes
from kiteline_lab.flights.flight_report import table
from kiteline_lab.flights.judge import judge

MODES = ("tracker", "local", "monolith", "distributed")
PROFILES = {"wifi": (0, 0), "radio": (1000, 500)}  # B/s up and down on the wire; 0: what the link takes
_FILES = ("live.tum", "odometry.tum", "stderr.log", "map.ply", "grid.pgm", "grid.yaml")


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line says."""

    sources: tuple[str, ...]
    out: Path
    mode: str = "distributed"
    link: str = ""
    profile: str = ""
    delay_s: float = 0.0
    up_bytes_s: int = 0
    down_bytes_s: int = 0
    loss: float = 0.0
    cpu_percent: float = 0.0
    mono: bool = False
    imu: bool = True
    realtime: bool = False
    config: str = ""
    seed: int = 0
    seconds: float = 0.0
    store: str = ""
    kill_base_at_s: float = -1.0
    restart_base_at_s: float = -1.0
    kill_agent_at_s: float = -1.0
    base_deaths: tuple[tuple[float, float], ...] = ()  # s of flight time, and s of real time after it; each restarts


@dataclass(slots=True)
class Plan:
    """A flight about to begin: the opened sources and what each process is told."""

    sources: list[FrameSource] = field(default_factory=list)
    agents: list[AgentOptions] = field(default_factory=list)
    base: BaseOptions | None = None
    frames: int | None = None

    def close(self) -> None:
        """Close the sources."""
        for source in self.sources:
            source.close()


def parser() -> argparse.ArgumentParser:
    """The arguments of `kiteline fly`."""
    p = argparse.ArgumentParser(
        prog="kiteline fly",
        description="Fly recordings or a simulation: one agent a SOURCE, and a base, as processes of this machine over "
        "a real link, in lock-step unless --realtime. Leaves trajectories, map, grid, logs, a plot and report.json.",
        epilog=f"SOURCE is {source_forms()}.",
    )
    p.add_argument("sources", metavar="SOURCE", nargs="+")
    p.add_argument("--out", metavar="DIR", required=True, type=Path, help="where everything is left")
    p.add_argument("--mode", choices=MODES, default="distributed",
                   help="tracker: no base; local: agent and base in one process with the codec between; monolith: the "
                   "same with plain floats; distributed: processes and a link (default)")  # fmt: skip
    p.add_argument("--link", metavar="LINK", default="", help="zenoh:tcp/HOST:PORT; default: a free loopback port")
    p.add_argument("--link-bytes", metavar="UP[,DOWN]", default="", help="B/s on the wire each way, headers included")
    p.add_argument("--link-loss", metavar="P", type=float, default=0.0,
                   help="lose packets with this probability, and double and reorder them with the same")  # fmt: skip
    p.add_argument("--profile", choices=tuple(PROFILES), default="",
                   help="cost of a keyframe; radio: 1000 B/s up, 500 B/s down; default: by the link")  # fmt: skip
    p.add_argument("--link-delay", metavar="S", type=float, default=0.0, help="s that a packet is under way")
    p.add_argument("--cpu", metavar="PERCENT", type=float, default=0.0, help="of one core, for each agent")
    p.add_argument("--mono", action="store_true", help="the left camera alone")
    p.add_argument("--no-imu", action="store_true", help="without inertial samples")
    p.add_argument("--realtime", action="store_true", help="real clocks, frames paced by their stamps")
    p.add_argument("--config", metavar="F", default="", help="a TOML file with [agent] and [base] sections")
    p.add_argument("--seed", metavar="N", type=int, default=0, help="of the link model")
    p.add_argument("--seconds", metavar="S", type=float, default=0.0, help="fly only so much of the source")
    p.add_argument("--store", metavar="DIR", default="", help="the base keeps its map here, and goes on from it")
    for hook in ("--kill-base-at", "--restart-base-at", "--kill-agent-at"):
        p.add_argument(hook, metavar="S", type=float, default=-1.0, help=argparse.SUPPRESS)
    return p


def options(argv: list[str]) -> Options:
    """The parsed command line; a wrong one ends the program with a usage line."""
    p = parser()
    a = p.parse_args(argv)
    up, down = PROFILES.get(a.profile, (0, 0))
    if a.link_bytes:
        try:
            up, down = link_bytes(a.link_bytes)
        except ValueError as error:
            p.error(str(error))
    if not 0.0 <= a.link_loss < 1.0:
        p.error(f"--link-loss {a.link_loss}: expected a probability from 0 to below 1")
    if a.cpu < 0.0 or a.seconds < 0.0:
        p.error("--cpu and --seconds must not be negative")
    return Options(
        tuple(a.sources), a.out, a.mode, a.link, a.profile, a.link_delay, up, down, a.link_loss, a.cpu, a.mono,
        not a.no_imu, a.realtime,
        a.config, a.seed, a.seconds, a.store, a.kill_base_at, a.restart_base_at, a.kill_agent_at,
    )  # fmt: skip


def link_bytes(text: str) -> tuple[int, int]:
    """B/s up and down of UP[,DOWN]; one number means both. Raises ValueError."""
    parts = text.split(",")
    if not 1 <= len(parts) <= 2 or not all(part.isdecimal() for part in parts):
        raise ValueError(f"--link-bytes {text!r}: expected UP or UP,DOWN in bytes a second, such as 1000,500")
    return int(parts[0]), int(parts[-1])


def plan(o: Options) -> Plan:
    """Open the sources, so that a bad one is told before anything starts, and say what each process does."""
    made = Plan()
    try:
        for text in o.sources:
            made.sources.append(open_source(text, mono=o.mono, imu=o.imu))
        starts = flight_starts(made.sources)
    except BaseException:
        made.close()
        raise
    counts = [source.frame_count for source in made.sources]
    boot = process.next_number(Path(o.store) / "session") if o.store else 0  # nothing in one store is named twice
    made.frames = None if o.seconds > 0 or None in counts else sum(count or 0 for count in counts)
    for k, text in enumerate(o.sources):
        made.agents.append(
            AgentOptions(
                source=text, folder=str(o.out / f"agent{k}"), agent=k, boot=boot, mono=o.mono, imu=o.imu,
                config=o.config,
                start_ns=starts[k], seconds=o.seconds, up_bytes_s=o.up_bytes_s, profile=o.profile,
                delay_s=o.delay_s, loss=o.loss, disorder=o.loss,
                seed=o.seed * 64 + k, cpu_percent=o.cpu_percent,
                kill_at_s=o.kill_agent_at_s if k == 0 else -1.0,
                await_base_at_s=o.restart_base_at_s, await_bases=bool(o.base_deaths),
            )
        )  # fmt: skip
    if o.mode != "tracker":
        made.base = BaseOptions(
            folder=str(o.out / "base"), agents=tuple(range(len(o.sources))), config=o.config, start_ns=starts[0],
            down_bytes_s=o.down_bytes_s, profile=o.profile, delay_s=o.delay_s, loss=o.loss, disorder=o.loss,
            seed=o.seed, session=max(1, boot), store=o.store, kill_at_s=o.kill_base_at_s,
        )  # fmt: skip
    return made


def flight_starts(sources: list[FrameSource]) -> list[int]:
    """Each source's stamp of flight time 0: sources that overlap in time share a clock, others begin together."""
    spans = [_span_ns(source, several=len(sources) > 1) for source in sources]
    if max(first for first, _ in spans) < min(last for _, last in spans):
        return [min(first for first, _ in spans)] * len(spans)
    return [first for first, _ in spans]


def _span_ns(source: FrameSource, several: bool) -> tuple[int, int]:
    """First and (nearly) last stamp of a source; the last is only worth finding out where there are several sources."""
    stamps: list[int] = []
    for item in source:
        if isinstance(item, Frame):
            stamps.append(item.t_ns)
            if len(stamps) == 1 + several:
                break
    if not stamps:
        raise SourceError(f"{source.name}: not one usable frame")
    period_ns = stamps[-1] - stamps[0]
    return stamps[0], stamps[0] + period_ns * max(1, source.frame_count or 1)


def clear(out: Path) -> None:
    """Remove what an earlier flight left in the folder, and nothing else."""
    for folder in [out / "base", *out.glob("agent[0-9]*")]:
        for path in [*(folder / name for name in _FILES), *folder.glob("agent[0-9]*.tum"), *folder.glob("log*.mcap")]:
            path.unlink(missing_ok=True)
    for name in ("report.json", "trajectory.png"):
        (out / name).unlink(missing_ok=True)
    out.mkdir(parents=True, exist_ok=True)


def fly(o: Options, quiet: bool = False) -> tuple[dict[str, object], Outcome]:
    """Fly and judge; the report as written, and how the flight went. Raises SourceError, LinkError, ConfigError."""
    if o.realtime and o.mode != "distributed":
        raise LinkError(f"--realtime flies processes over a link: it does not go with --mode {o.mode}")
    made = plan(o)
    with contextlib.closing(made):
        clear(o.out)
        flight = Flight(made.agents, made.base, made.frames, quiet, o.base_deaths)
        if o.mode == "distributed":
            outcome = fly_processes(flight, o.link, o.realtime)
        else:
            outcome = fly_here(flight, made.sources, o.mode)
        mend_logs(o.out)
        report = judge(o.out, made.sources, made.agents, outcome, align_scale=o.mono)
    return report, outcome


def mend_logs(out: Path) -> None:
    """Finish the logs of processes that were ended in mid-flight, so that every tool opens them."""
    for log in [*out.glob("agent[0-9]*/*.mcap"), *out.glob("base/*.mcap")]:
        with contextlib.suppress(SourceError):  # not one byte was written
            repair(log)


def main(argv: list[str]) -> int:
    """Run `kiteline fly`; the exit status: 1 when an agent or the base failed."""
    o = options(argv)
    report, outcome = fly(o)
    print(table(report))
    print(f"plot: {o.out / 'trajectory.png'}")
    print(f"report: {o.out / 'report.json'}")
    return 1 if outcome.failed else 0

"""`kiteline fly`: agents and a base fly as processes of this machine, or in this one, and leave a folder of results."""

import argparse
import contextlib
import math
import sys
from pathlib import Path

from kiteline_agent.runtime.options import GRIDS, TRACKERS
from kiteline_basestation.runtime import base_runtime
from kiteline_core.arguments import limit
from kiteline_hw.logs.mcap_repair import repair
from kiteline_hw.ports import LinkError, SourceError
from kiteline_hw.sources.kinds import source_forms
from kiteline_lab.flights.flight_report import Report, table
from kiteline_lab.flights.in_process import fly_in_process
from kiteline_lab.flights.outcome import FlightOutcome
from kiteline_lab.flights.plan import Options, plan
from kiteline_lab.flights.processes import fly_processes, link_ends
from kiteline_lab.flights.results import write_results
from kiteline_lab.outputs.out_file import sole_writer
from kiteline_lab.plots.plot import can_plot

MODES = ("tracker", "local", "monolith", "distributed")
PROFILES = {"wifi": (0, 0), "radio": (1000, 500)}  # B/s up and down on the wire; 0: what the link takes
_FILES = ("live.tum", "odometry.tum", "stderr.log", "map.ply", "grid.pgm", "grid.yaml")
_PATTERNS = ("agent[0-9]*.tum", "log*.mcap", "grid_*.pgm", "grid_*.yaml")


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
    p.add_argument(
        "--cpu",
        metavar="PERCENT",
        type=limit,
        default=0.0,
        help="of one core: for each agent, or for all together with --mode local or monolith; default: all there is",
    )
    p.add_argument("--mono", action="store_true", help="the left camera alone")
    p.add_argument("--no-imu", action="store_true", help="without inertial samples")
    p.add_argument("--realtime", action="store_true", help="real clocks, frames paced by their stamps")
    p.add_argument("--config", metavar="F", default="", help="a TOML file with [agent] and [base] sections")
    p.add_argument("--rig", metavar="FILE", default="",
                   help="begin with what earlier flights found of the rig, and write what this one finds")  # fmt: skip
    p.add_argument("--calibration", metavar="FILE[,FILE]", default="",
                   help="cameras, extrinsics and IMU noise in place of what each SOURCE says")  # fmt: skip
    p.add_argument("--grid", choices=GRIDS, default="agent",
                   help="who looks for ground and obstacles: the agents (default), the base in images that a wide "
                   "link carries, or nobody")  # fmt: skip
    p.add_argument("--tracker", choices=TRACKERS, default="",
                   help="map (default), or ekf: a Kalman filter for one camera with odometry and hardly any CPU; it "
                   "makes no scans and reads no IMU")  # fmt: skip
    p.add_argument("--seed", metavar="N", type=int, default=0, help="of the link model")
    p.add_argument(
        "--seconds", metavar="S", type=limit, default=0.0, help="fly only so much of the source; default: all"
    )
    p.add_argument("--store", metavar="DIR", default="", help="the base keeps its map here, and goes on from it")
    for hook in ("--kill-base-at", "--restart-base-at", "--kill-agent-at"):
        p.add_argument(hook, metavar="S", type=float, help=argparse.SUPPRESS)
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
    if not 0.0 <= a.link_delay < math.inf:
        p.error(f"--link-delay {a.link_delay}: expected seconds, 0 or more")
    if a.rig and len(a.sources) > 1:
        p.error("--rig is the file of one rig: it goes with one SOURCE")
    if a.out.exists() and not a.out.is_dir():
        p.error(f"--out {a.out} is a file: name a folder")
    return Options(
        tuple(a.sources), a.out, a.mode, a.link, a.profile, a.link_delay, up, down, a.link_loss, a.cpu, a.mono,
        not a.no_imu, a.realtime,
        a.config, a.rig, a.seed, a.seconds, a.store, a.kill_base_at, a.restart_base_at, a.kill_agent_at,
        calibration=a.calibration, grid=a.grid, tracker=a.tracker,
    )  # fmt: skip


def link_bytes(text: str) -> tuple[int, int]:
    """B/s up and down of UP[,DOWN]; one number means both. Raises ValueError."""
    parts = text.split(",")
    if not 1 <= len(parts) <= 2 or not all(part.isdecimal() for part in parts):
        raise ValueError(f"--link-bytes {text!r}: expected UP or UP,DOWN in bytes a second, such as 1000,500")
    return int(parts[0]), int(parts[-1])


def clear(out: Path) -> None:
    """Remove what an earlier flight left in the folder, and nothing else; make the folder if need be."""
    for folder in [out / "base", *out.glob("agent[0-9]*")]:
        named = (path for pattern in _PATTERNS for path in folder.glob(pattern))
        for path in [*(folder / name for name in _FILES), *named]:
            path.unlink(missing_ok=True)
    for name in ("report.json", "trajectory.png"):
        (out / name).unlink(missing_ok=True)
    out.mkdir(parents=True, exist_ok=True)


def fly(o: Options, quiet: bool = False) -> tuple[Report, FlightOutcome]:
    """Fly and evaluate; the report as written, and the outcome. Raises SourceError, LinkError, ConfigError."""
    distributed = o.mode == "distributed"
    if o.realtime and not distributed:
        raise LinkError(f"--realtime flies processes over a link: it does not go with --mode {o.mode}")
    if distributed:
        link_ends(o.link, realtime=o.realtime)  # a wrong one is told before an earlier flight is removed
    made = plan(o, quiet)
    with contextlib.closing(made), sole_writer(o.out):
        clear(o.out)
        outcome = fly_processes(made, o.link, realtime=o.realtime) if distributed else fly_in_process(made, o.mode)
        repair_logs(o.out)
        report = write_results(o.out, made, outcome)
    return report, outcome


def repair_logs(out: Path) -> None:
    """Finish the logs of processes that were ended in mid-flight, so that every tool opens them."""
    for log in [*out.glob("agent[0-9]*/*.mcap"), *out.glob("base/*.mcap")]:
        with contextlib.suppress(SourceError, OSError):  # not one byte was written, or the disk takes no second copy
            repair(log)


def missing_extras(mode: str) -> list[str]:
    """What this flight goes without, as the plain install leaves it out; a line each with the mend."""
    lines = [] if mode == "tracker" else base_runtime.missing_extras()
    if not can_plot():
        lines.append("matplotlib is not installed: no trajectory.png; pip install 'kiteline[lab]'")
    return lines


def main(argv: list[str]) -> int:
    """Run `kiteline fly`; the exit status: 1 when an agent or the base failed."""
    o = options(argv)
    for line in missing_extras(o.mode):
        print(f"kiteline: note: {line}", file=sys.stderr)
    report, outcome = fly(o)
    print(table(report))
    if (o.out / "trajectory.png").exists():
        print(f"plot: {o.out / 'trajectory.png'}")
    print(f"report: {o.out / 'report.json'}")
    return 1 if outcome.failed else 0

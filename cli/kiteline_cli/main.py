"""The `kiteline` command: finds the subcommand, hands it the rest of the line, turns known errors into one line.

Only argparse is loaded here, so `kiteline --help` answers at once. Each subcommand parses its arguments in its room.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from kiteline_cli.examples import EXAMPLES

EXIT_ERROR = 2  # as argparse uses for a wrong command line
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it


@dataclass(frozen=True, slots=True)
class Command:
    """One subcommand. `name` is also the module kiteline_cli.commands.<name>, which has `run(argv) -> int`."""

    name: str
    summary: str


COMMANDS = (
    Command("fly", "fly recordings or a simulation: agents and a base as processes of this machine"),
    Command("eval", "judge a trajectory against ground truth: ATE, RPE, KITTI drift, coverage"),
    Command("grid", "judge an occupancy grid: precision and recall of the roads drawn on it"),
    Command("sim", "record a simulated flight"),
    Command("agent", "the onboard half: camera in, pose out, thin diffs to the base"),
    Command("base", "the base station: maps for any number of agents"),
    Command("replay", "run an agent or a base again from its log, and compare"),
    Command("convert", "turn a data set or a ROS 2 bag into a kiteline log"),
    Command("log", "look into logs and mend them: info, recover, cut, merge"),
    Command("export", "a base's map in the formats of other tools: TUM, PLY, PGM, g2o"),
    Command("maps", "the maps of a running base: list, get, name, merge, split, delete"),
    Command("keys", "make and show the keys with which agents and base seal their packets"),
    Command("doctor", "check this machine, and warm the compiled kernels"),
    Command("bench", "measure, and write docs/results.md"),
)

# Raised on purpose, with a text for the user. Looked up among loaded modules: what was raised has been imported.
KNOWN_ERRORS = (
    ("kiteline_core.geometry.cameras", "CalibrationError"),
    ("kiteline_core.config", "ConfigError"),
    ("kiteline_codec.schema", "WireError"),
    ("kiteline_basestation.store.store", "StoreError"),
    ("kiteline_hw.ports", "SourceError"),
    ("kiteline_hw.ports", "LinkError"),
    ("kiteline_lab.evaluation.trajectories", "TrajectoryError"),
)

# Which extra brings a package that the plain install leaves out.
EXTRAS = {"gtsam": "base", "websockets": "base", "matplotlib": "lab"}

_EXAMPLES = """\
examples:
  kiteline sim room --out room.mcap            record a simulated flight through a room
  kiteline fly room.mcap --out out             fly it: an agent and a base, linked over loopback
  kiteline eval out/base/agent0.tum room.mcap  how far from the truth?
  kiteline fly euroc:V1_01_easy --out out --profile radio
                                               a EuRoC folder over the budget of a telemetry radio
  kiteline base --link zenoh:tcp/0.0.0.0:7447 --web 0.0.0.0:8080
  kiteline agent mcap:bag.mcap --link zenoh:tcp/10.0.0.1:7447
                                               a base on one machine, an agent on another

SOURCE is euroc:DIR kitti:DIR tum:DIR mcap:FILE sim:SCENE images:GLOB, or a plain path, recognised by its layout.
LINK   is zenoh:ENDPOINT serial:DEV:BAUD mavlink:URL none.
`kiteline COMMAND --help` says more about each."""


def parser() -> argparse.ArgumentParser:
    """The parser of everything before the subcommand."""
    width = max(len(c.name) for c in COMMANDS)
    table = "\n".join(f"  {c.name:{width}}  {c.summary}" for c in COMMANDS)
    p = argparse.ArgumentParser(
        prog="kiteline",
        usage="kiteline COMMAND [arguments]",
        description="Visual SLAM for small drones: a light tracker on board, the map on a base station, "
        f"a thin link between.\n\ncommands:\n{table}",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--version", action="store_true", help="print the version and leave")
    p.add_argument("--debug", action="store_true", help="before COMMAND: show the traceback of an error")
    return p


def main(argv: Sequence[str]) -> int:
    """Run one command line; the exit status."""
    rest = list(argv)
    debug = rest[:1] == ["--debug"]
    if debug:
        rest = rest[1:]
    names = [c.name for c in COMMANDS]
    if not rest or rest[0] not in names:
        return _without_command(rest, names)
    # Small matrices only: extra BLAS threads would spin, not help. Children inherit this.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    module = importlib.import_module(f"kiteline_cli.commands.{rest[0]}")
    command: Callable[[list[str]], int | None] = module.run
    try:
        return command(rest[1:]) or 0
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains again while it ends
        return EXIT_ERROR
    except Exception as error:
        text = explanation(error)
        if debug or text is None:
            raise
        print(f"kiteline: error: {text}", file=sys.stderr)
        return EXIT_ERROR
    finally:
        if rest[1:2] in (["-h"], ["--help"]):
            print("\nexamples:", *EXAMPLES[rest[0]], sep="\n  ")


def explanation(error: Exception) -> str | None:
    """One line for an error that the user can mend; None for a fault of the program."""
    known = [getattr(sys.modules[m], n) for m, n in KNOWN_ERRORS if m in sys.modules and hasattr(sys.modules[m], n)]
    if isinstance(error, tuple(known)):
        return " ".join(str(error).split())
    if isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] in EXTRAS:
        extra = EXTRAS[(error.name or "").split(".")[0]]
        return f"{error.name} is not installed; this needs: pip install 'kiteline[{extra}]'"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return None


def _without_command(rest: list[str], names: list[str]) -> int:
    p = parser()
    if not rest:
        p.print_help()
        return EXIT_ERROR
    if not rest[0].startswith("-"):
        near = difflib.get_close_matches(rest[0], names, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(names)}"
        print(f"kiteline: error: no command {rest[0]!r}; {hint}", file=sys.stderr)
        return EXIT_ERROR
    options = p.parse_args(rest)
    if options.version:
        from importlib.metadata import version

        print(f"kiteline {version('kiteline')}")
        return 0
    p.print_help()
    return EXIT_ERROR


def run() -> None:
    """Entry point of the installed script."""
    sys.exit(main(sys.argv[1:]))

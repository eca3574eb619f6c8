"""The `kiteline` command: finds the subcommand and hands it the rest of the command line.

Only argparse is loaded here, so that `kiteline --help` answers at once. Each subcommand parses its own arguments.
"""

import argparse
import contextlib
import difflib
import errno
import importlib
import io
import os
import pkgutil
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from types import FrameType, ModuleType
from typing import NoReturn

from kiteline_cli import commands
from kiteline_core.errors import KitelineError
from kiteline_hw.links.kinds import link_table
from kiteline_hw.sources.kinds import source_table
from kiteline_hw.system import process

EXIT_ERROR = 2  # as argparse uses for a wrong command line
EXIT_SIGNAL = 128  # plus the number of the signal, as shells report it
_TERMINATED = EXIT_SIGNAL + signal.SIGTERM
_WHILE_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # such errors of a disk name no file
_IMPORTER = "<frozen importlib._bootstrap>"  # the file of frames that load a module

# Which extra brings a package that the plain install leaves out.
EXTRAS = {"gtsam": "base", "websockets": "base", "matplotlib": "lab"}

# What a user can do about an error of the file system, where its own words do not say it.
_MENDS = {
    errno.ENOTDIR: "a file stands where a folder is expected; name another place",
    errno.EISDIR: "expected a file",
    errno.EACCES: "name another place, or change who may read and write this one",
    errno.EPERM: "name another place, or change who may read and write this one",
    errno.EROFS: "name a place on another disk",
    errno.ENOSPC: "free some, or name a place on another disk",
}

_EXAMPLES = """\
examples:
  kiteline sim room --out room.mcap            record a simulated flight through a room
  kiteline fly room.mcap --out out             fly it: an agent and a base, linked over loopback
  kiteline eval out/base/agent0.tum room.mcap  compare the trajectory with the truth
  kiteline fly euroc:V1_01_easy --out out --profile radio
                                               a EuRoC folder over the budget of a telemetry radio
  kiteline base --link zenoh:tcp/0.0.0.0:7447 --web 0.0.0.0:8080
  kiteline agent mcap:bag.mcap --link zenoh:tcp/10.0.0.1:7447
                                               a base on one machine, an agent on another

SOURCE, or a plain path, which is recognised by its layout:
{sources}
LINK:
{links}
`kiteline COMMAND --help` says more about each command."""


@dataclass(frozen=True, slots=True)
class Command:
    """A subcommand: its name and the module in `kiteline_cli.commands` that holds it."""

    name: str
    module: str

    def load(self) -> ModuleType:
        """The module, with SUMMARY, EXAMPLES and run(argv)."""
        return importlib.import_module(self.module)


def find_commands() -> dict[str, list[Command]]:
    """All subcommands by group title, in the order of `kiteline --help`."""
    found: dict[str, list[Command]] = {}
    for group in commands.GROUPS:
        package = importlib.import_module(f"{commands.__name__}.{group}")
        names = [module.name for module in pkgutil.iter_modules(package.__path__)]
        found[(package.__doc__ or group).strip(".")] = [
            Command(n.replace("_", "-"), f"{package.__name__}.{n}") for n in names
        ]
    return found


def parser() -> argparse.ArgumentParser:
    """The parser of everything before the subcommand."""
    groups = find_commands()
    width = max(len(c.name) for group in groups.values() for c in group)
    table = "\n\n".join(
        f"{title}:\n" + "\n".join(f"  {c.name:{width}}  {c.load().SUMMARY}" for c in group)
        for title, group in groups.items()
    )
    p = argparse.ArgumentParser(
        prog="kiteline",
        usage="kiteline COMMAND [arguments]",
        description="Visual SLAM for small drones: a light tracker on board, the map on a base station, "
        f"a thin link between.\n\n{table}",
        epilog=_EXAMPLES.format(sources=source_table(), links=link_table()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--version", action="store_true", help="print the version and exit")
    p.add_argument("--debug", action="store_true", help="before COMMAND: show the traceback of an error")
    return p


def main(argv: Sequence[str]) -> int:
    """Run one command line; the exit status. A reader of the output that goes away, as `head` does, ends it quietly."""
    try:
        try:
            return _run(list(argv))
        finally:
            _flush_output()  # here, where a closed pipe and a full disk can be caught
    except KeyboardInterrupt:
        return EXIT_SIGNAL + signal.SIGINT
    except _Terminated:
        return _TERMINATED
    except BrokenPipeError:
        return EXIT_ERROR
    except OSError as error:
        text = explanation(error)
        if argv[:1] == ["--debug"] or text is None:
            raise
        return _tell(text)


def _flush_output() -> None:
    """Write out what was printed. Raises OSError; what could not be written is then forgotten."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains again at exit
        raise


def _tell(text: str) -> int:
    """Print an error; the exit status."""
    print(f"kiteline: error: {text}", file=sys.stderr)
    return EXIT_ERROR


class _Terminated(BaseException):
    """SIGTERM came."""


def _on_signal(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or _Terminated for SIGTERM: what is half written is removed on the way out.

    While modules load, end at once: libraries swallow it there, or end with a traceback.
    """
    if not process.can_raise(frame):
        return process.deliver_again(number, _on_signal)
    while frame is not None:
        if frame.f_code.co_filename == _IMPORTER:
            _end(EXIT_SIGNAL + number)
        frame = frame.f_back
    raise KeyboardInterrupt if number == signal.SIGINT else _Terminated


def _end(status: int) -> NoReturn:
    """End the process at once; after SIGTERM by that signal, which systemd takes for an end in order."""
    if status == _TERMINATED:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)
    os._exit(status)


def _run(rest: list[str]) -> int:
    debug = rest[:1] == ["--debug"]
    if debug:
        rest = rest[1:]
    known = {c.name: c for group in find_commands().values() for c in group}
    if not rest or rest[0] not in known:
        return _without_command(rest, sorted(known))
    # Small matrices only: extra BLAS threads would spin, not help. Child processes inherit this.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    command = known[rest[0]].load()
    try:
        return command.run(rest[1:]) or 0
    except Exception as error:
        text = explanation(error)
        if debug or text is None or isinstance(error, OSError):  # which `main` explains, with those of its own output
            raise
        return _tell(text)
    finally:
        if rest[1:2] in (["-h"], ["--help"]):
            print("\nexamples:", *command.EXAMPLES, sep="\n  ")


def explanation(error: Exception) -> str | None:
    """One line for an error that the user can mend; None for a fault of the program."""
    if isinstance(error, KitelineError):
        return " ".join(str(error).split())
    if isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] in EXTRAS:
        extra = EXTRAS[(error.name or "").split(".")[0]]
        return f"{error.name} is not installed; this needs: pip install 'kiteline[{extra}]'"
    if isinstance(error, OSError) and (error.filename is not None or error.errno in _WHILE_WRITING):
        mend = _MENDS.get(error.errno or 0)
        named = "" if error.filename is None else f"{error.filename}: "
        return f"{named}{error.strerror}" + (f": {mend}" if mend else "")
    return None


def _without_command(rest: list[str], names: list[str]) -> int:
    if rest and not rest[0].startswith("-"):
        near = difflib.get_close_matches(rest[0], names, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(names)}"
        return _tell(f"no command {rest[0]!r}; {hint}")
    p = parser()
    if rest[:1] in (["-h"], ["--help"]):  # here, for argparse passes over a disk that does not take it
        sys.stdout.write(p.format_help())
        return 0
    if rest and p.parse_args(rest).version:
        from importlib.metadata import version

        print(f"kiteline {version('kiteline')}")
        return 0
    sys.stdout.write(p.format_help())
    return EXIT_ERROR


def run() -> None:
    """The command line of this process."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _on_signal)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed by the caller; a log or a socket would take its number
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal in ASCII, a file name in another encoding
            with contextlib.suppress(OSError):  # of a stream that has its place in a file no more
                stream.reconfigure(errors="backslashreplace")
    status = main(sys.argv[1:])
    if status == _TERMINATED:
        _end(status)
    sys.exit(status)

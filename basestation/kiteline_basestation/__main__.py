"""The base station as a process: `kiteline base`, or a child of `kiteline fly` (--spec)."""

import secrets
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from kiteline_basestation.runtime.live import fly_live
from kiteline_basestation.runtime.lockstep import fly_lockstep
from kiteline_basestation.runtime.options import LOG_STEM, BaseOptions, options_of, parser
from kiteline_core import config as configuration
from kiteline_core.errors import KitelineError
from kiteline_hw.links.kinds import link_forms
from kiteline_hw.links.sealing import sealing_of
from kiteline_hw.logs.log_budget import newest_start
from kiteline_hw.system import process
from kiteline_hw.system.start_numbers import numbers_in

_EPOCH_S = 1_735_689_600  # s of Unix time at which 2025 began
_UNIT_S = 10  # s in which sessions of bases are counted since then
_DRAWN_BITS = 16  # of a session: two bases that start together have different ones


def main(argv: Sequence[str] | None = None) -> int:
    """Run until stopped; the exit status."""
    p = parser(link_forms())
    a = p.parse_args(argv)
    if a.spec:
        options = configuration.from_json(BaseOptions, a.spec)
        expected = (KitelineError, ValueError)
        process.exit_now(
            process.run_child(options.link, partial(fly_lockstep, options), partial(fly_live, options), expected)
        )
    if not a.quiet:
        process.print_lines(["loading the base, for some seconds"])
    sealing = sealing_of(a.link, "base", 0, a.key, insecure=a.insecure)
    a.key, a.told = sealing.key, sealing.lines
    if a.paired_only and not (a.key and a.link.startswith("zenoh:")):
        p.error("--paired-only needs an IP link that is sealed: --link zenoh:… beyond this machine, or --key FILE")
    if a.paired_only and a.link.startswith("zenoh:router/"):
        p.error("--paired-only: whom a router lets in is told to that router, not to this base")
    # Time since a fixed date: a base on another machine, without this one's files, still begins a later session.
    least = max(0, int(time.time()) - _EPOCH_S) // _UNIT_S << _DRAWN_BITS | secrets.randbelow(1 << _DRAWN_BITS)
    # Above those of the logs, too: the log of a lower session would count as older than they.
    least = max(1, least, 1 + newest_start(Path(a.log), LOG_STEM) if a.log else 0)
    start = numbers_in(process.kept_folder("base")).next(least)
    if start.kept:
        process.print_lines([f"the number of this session cannot be kept: {start.kept}"])
    process.outlive_terminal()
    stored = fly_live(options_of(a, start.order), None, process.StopSignal())
    process.exit_now(0 if stored else 1)


if __name__ == "__main__":
    raise SystemExit(main())

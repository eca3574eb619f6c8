"""The base station as a process: `kiteline base`, or a child of `kiteline fly` (--spec)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from kiteline_basestation.runtime.live import fly_live
from kiteline_basestation.runtime.lockstep import fly_lockstep
from kiteline_basestation.runtime.options import BaseOptions, options_of, parser
from kiteline_basestation.store.checksums import StoreError
from kiteline_codec.schema import WireError
from kiteline_core import config as configuration
from kiteline_hw.links.kinds import link_forms
from kiteline_hw.ports import LinkError, SourceError
from kiteline_hw.system import process

_SESSION_EPOCH_S = 1_735_689_600  # s of Unix time at which 2025 began: sessions are counted in seconds since then


def main(argv: Sequence[str] | None = None) -> int:
    """Run until stopped; the exit status."""
    p = parser(link_forms())
    a = p.parse_args(argv)
    if a.spec:
        options = configuration.from_json(BaseOptions, a.spec)
        expected = (LinkError, SourceError, StoreError, WireError, ValueError)
        process.exit_now(
            process.run_child(options.link, partial(fly_lockstep, options), partial(fly_live, options), expected)
        )
    if not a.link:
        p.error("a --link is needed, such as zenoh:tcp/0.0.0.0:7447")
    # Seconds since a fixed date: a base on another machine, without this one's files, still begins a later session.
    folder = Path(a.store) if a.store else process.state_folder() / "base"
    session = process.next_number(folder / "session", int(time.time()) - _SESSION_EPOCH_S)
    stored = fly_live(options_of(a, session), None, process.StopSignal())
    process.exit_now(0 if stored else 1)


if __name__ == "__main__":
    raise SystemExit(main())

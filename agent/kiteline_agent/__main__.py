"""`kiteline agent`: the onboard half as a process."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from kiteline_agent.runtime.live import fly_live
from kiteline_agent.runtime.lockstep import fly_lockstep
from kiteline_agent.runtime.options import AgentOptions, check, options_of, parser
from kiteline_core import config as configuration
from kiteline_core.errors import KitelineError
from kiteline_hw.links.kinds import MAVLINK_FORMS, link_forms
from kiteline_hw.links.sealing import sealing_of
from kiteline_hw.sources.kinds import source_forms
from kiteline_hw.system import process
from kiteline_hw.system.start_numbers import numbers_in


def main(argv: Sequence[str] | None = None) -> int:
    """`kiteline agent`, and a child of `kiteline fly` (with --spec); the exit status."""
    p = parser(f"SOURCE is {source_forms()}. LINK is {link_forms()}. URL is {MAVLINK_FORMS}.")
    a = p.parse_args(argv)
    if a.spec:
        options = configuration.from_json(AgentOptions, a.spec)
        expected = (KitelineError, ValueError)
        process.exit_now(
            process.run_child(options.link, partial(fly_lockstep, options), partial(fly_live, options), expected)
        )
    check(p, a)
    sealing = sealing_of(a.link, "agent", a.agent, a.key, insecure=a.insecure)
    a.key, a.told = sealing.key, sealing.lines
    kept = process.kept_folder(f"agent{a.agent}")
    options = options_of(a, Path(a.log) / kept.name if a.log else kept)
    process.outlive_terminal()
    fly_live(options, None, process.StopSignal(), numbers_in(kept))
    process.exit_now(0)


if __name__ == "__main__":
    raise SystemExit(main())

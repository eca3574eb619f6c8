"""`kiteline fly`: agents and a base as processes of this machine."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline fly` and do it; the exit status."""
    from kiteline_lab.flights.fly import main

    return main(argv)

"""`kiteline sim`: record a simulated flight."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline sim` and do it; the exit status."""
    from kiteline_lab.flights.simulate import main

    return main(argv)

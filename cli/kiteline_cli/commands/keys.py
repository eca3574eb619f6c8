"""`kiteline keys`: make and show the keys with which packets are sealed."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline keys` and do it; the exit status."""
    from kiteline_lab.tools.keys import main

    return main(argv)

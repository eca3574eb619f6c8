"""`kiteline agent`: the onboard half."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline agent` and do it; the exit status."""
    from kiteline_agent.__main__ import main

    return main(argv)

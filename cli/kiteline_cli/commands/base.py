"""`kiteline base`: the base station."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline base` and do it; the exit status."""
    from kiteline_basestation.__main__ import main

    return main(argv)

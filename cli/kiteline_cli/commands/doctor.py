"""`kiteline doctor`: check this machine."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline doctor` and do it; the exit status."""
    from kiteline_lab.tools.doctor import main

    return main(argv)

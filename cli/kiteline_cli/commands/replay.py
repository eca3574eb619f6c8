"""`kiteline replay`: run an agent or a base again from its log."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline replay` and do it; the exit status."""
    from kiteline_lab.replay.replay import main

    return main(argv)

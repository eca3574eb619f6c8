"""`kiteline log`: look into logs and mend them."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline log` and do it; the exit status."""
    from kiteline_lab.tools.logs import main

    return main(argv)

"""`kiteline export`: a base's map in the formats of other tools."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline export` and do it; the exit status."""
    from kiteline_lab.tools.export import main

    return main(argv)

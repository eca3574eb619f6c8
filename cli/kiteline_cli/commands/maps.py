"""`kiteline maps`: the maps of a running base."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline maps` and do it; the exit status."""
    from kiteline_lab.tools.maps import main

    return main(argv)

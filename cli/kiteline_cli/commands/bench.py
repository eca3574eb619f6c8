"""`kiteline bench`: measure, and write docs/results.md."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline bench` and do it; the exit status."""
    from kiteline_bench.benchmark import main

    return main(argv)

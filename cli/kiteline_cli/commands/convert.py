"""`kiteline convert`: turn a data set or a ROS 2 bag into a log."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline convert` and do it; the exit status."""
    from kiteline_lab.tools.convert import main

    return main(argv)

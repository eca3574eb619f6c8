"""`kiteline eval`: judge a trajectory against ground truth."""

from __future__ import annotations


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline eval` and do it; the exit status."""
    from kiteline_lab.evaluation.evaluate import main

    return main(argv)

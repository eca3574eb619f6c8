"""`kiteline grid eval`: is an occupancy grid fit to plan on?"""

from __future__ import annotations

import sys


def run(argv: list[str]) -> int | None:
    """Parse the arguments after `kiteline grid` and do it; the exit status."""
    if argv[:1] != ["eval"]:
        asked = argv[:1] in (["-h"], ["--help"])
        stream = sys.stdout if asked else sys.stderr
        print("usage: kiteline grid eval EST.yaml TRUE.yaml [options]; --help after eval says more", file=stream)
        return 0 if asked else 2
    from kiteline_lab.evaluation.grid_eval import main

    return main(argv[1:])

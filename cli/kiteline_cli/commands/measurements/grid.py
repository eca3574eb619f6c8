"""`kiteline grid`."""

from __future__ import annotations

import sys

SUMMARY = "compare an occupancy grid with ground truth: precision and recall of roads drawn on it"
EXAMPLES = ("kiteline grid eval out/base/grid.yaml true.yaml",)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline grid`; the exit status."""
    if argv[:1] != ["eval"]:
        wants_help = argv[:1] in (["-h"], ["--help"])
        stream = sys.stdout if wants_help else sys.stderr
        print("usage: kiteline grid eval EST.yaml TRUE.yaml [options]; see kiteline grid eval --help", file=stream)
        return 0 if wants_help else 2
    from kiteline_lab.evaluation.grid_eval import main

    return main(argv[1:])

"""`kiteline grid`."""

import importlib
import sys

SUMMARY = "judge an occupancy grid, plan on it, or write the true one of a simulated flight"
EXAMPLES = (
    "kiteline grid eval out/base/grid.yaml true_seen.yaml --plot difference.png",
    "kiteline grid path out/base/grid.yaml 0,0 3.5,-1 --radius 0.3 --plot path.png",
    "kiteline grid truth 'sim:room?objects=1' --out true.yaml",
)
_ACTIONS = {
    "eval": ("EST.yaml TRUE.yaml", "precision and recall of a grid for paths", "kiteline_lab.grids.evaluate"),
    "path": ("GRID.yaml FROM TO", "the shortest path on which a vehicle touches nothing", "kiteline_lab.grids.path"),
    "truth": ("SOURCE --out F.yaml", "the true grid of a flight whose world is known", "kiteline_lab.grids.truth"),
}  # name -> arguments, what it does, module


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline grid`; the exit status."""
    if not argv or argv[0] not in _ACTIONS:
        wants_help = argv[:1] in (["-h"], ["--help"])
        stream = sys.stdout if wants_help else sys.stderr
        print("usage: kiteline grid VERB ...; see kiteline grid VERB --help\n", file=stream)
        for name, (arguments, about, _) in _ACTIONS.items():
            print(f"  {name} {arguments}".ljust(29) + about, file=stream)
        if argv and not wants_help:
            print(f"kiteline grid: error: no verb {argv[0]!r}: expected {', '.join(_ACTIONS)}", file=stream)
        return 0 if wants_help else 2
    status: int = importlib.import_module(_ACTIONS[argv[0]][-1]).main(argv[1:])
    return status

"""`kiteline grid truth SOURCE --out F.yaml`: the true occupancy of a recorded or simulated flight."""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from kiteline_hw.ports import SourceError
from kiteline_hw.sim.source import SimSource
from kiteline_hw.sim.truth.box_files import read_boxes
from kiteline_hw.sim.truth.occupancy import write_grid
from kiteline_hw.sim.truth.sight import CELL_M, RANGE_M, SeenWorld, look
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.process import told_if_slow

_LEAST_CELL_M = 0.005  # a room of 10 m has 4 million such cells


def seen_world(source: str, boxes: Path | None = None, cell_m: float = CELL_M, range_m: float = RANGE_M) -> SeenWorld:
    """What the true poses of a source saw of its world: that of a file of boxes, or of the simulator.

    Raises SourceError if the world or the poses are not known.
    """
    opened = open_source(source)
    try:
        truth = opened.ground_truth
        if truth is None:
            raise SourceError(f"{source}: it has no true poses")
        if boxes is None and not isinstance(opened, SimSource):
            raise SourceError(f"{source}: its world is not known; --boxes names a file that lists its solids")
        rig = opened.worn.true if isinstance(opened, SimSource) else opened.rig
        world = opened.world if isinstance(opened, SimSource) and boxes is None else read_boxes(boxes)  # type: ignore[arg-type]
        return look(world, rig.left, truth.T_w_b @ rig.T_b_c, cell_m=cell_m, range_m=range_m)
    finally:
        opened.close()


def write_truth(seen: SeenWorld, stem: Path) -> list[Path]:
    """Write STEM.yaml, all that is true, STEM_seen.yaml, what was seen of it, and the latter by height band."""
    bands = list(pairwise(seen.heights_m))
    return [
        write_grid(seen.grid(seen=False), stem.with_name(f"{stem.name}.yaml")),
        write_grid(seen.grid(), stem.with_name(f"{stem.name}_seen.yaml")),
        *(write_grid(seen.grid(a, b), stem.with_name(f"{stem.name}_seen_{a:g}-{b:g}.yaml")) for a, b in bands),
    ]


def main(argv: list[str]) -> int:
    """Run `kiteline grid truth`; the exit status. Raises SourceError."""
    parser = argparse.ArgumentParser(
        prog="kiteline grid truth",
        description="Write the true occupancy of a flight (F.yaml), what of it its true poses could see (F_seen.yaml; "
        "the rest is unknown), and the latter by height band.",
    )
    parser.add_argument("source", metavar="SOURCE", help="a recording with true poses, or sim:SCENE")
    parser.add_argument(
        "--boxes",
        type=Path,
        metavar="F.csv",
        help="solids of the world: centre x y z, half-extents x y z, yaw; the room itself first",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="F.yaml")
    parser.add_argument(
        "--cell", type=float, default=CELL_M, metavar="M", help="side of a cell (default %(default)s m)"
    )
    parser.add_argument(
        "--range",
        type=float,
        default=RANGE_M,
        metavar="M",
        help="largest horizontal distance of what is seen (default %(default)s m)",
    )
    args = parser.parse_args(argv)
    if not args.cell > 0.0 or not args.range > 0.0:
        parser.error("expected a positive side of a cell and a positive range")
    if not _LEAST_CELL_M <= args.cell < np.inf:
        parser.error(f"expected a side of a cell of {_LEAST_CELL_M:g} m or more")
    with told_if_slow(f"looking over the world of {args.source}"):
        seen = seen_world(args.source, args.boxes, args.cell, args.range)
    for file in write_truth(seen, args.out.with_suffix("")):
        print(f"{file}: true occupancy")
    return 0

"""`kiteline grid eval EST.yaml TRUE.yaml`: precision and recall of an occupancy grid, and a picture of both."""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64
from kiteline_lab.evaluation.metrics import MAX_DIFFERENCE_NS, truth_at
from kiteline_lab.evaluation.trajectories import TrajectoryError, read_pair
from kiteline_lab.grids.align import aligned, share_near
from kiteline_lab.grids.files import GridFile, planar, read_grid
from kiteline_lab.grids.picture import draw_comparison
from kiteline_lab.grids.prm import GridEvalConfig, score

_NEAR_M, _LEAST_NEAR = 0.3, 0.7  # of obstacles of grids in one frame: all in room_flight, half of them if turned


def between_paths(estimate: str, truth: str) -> F64:
    """(3,3) planar motion that maps the positions of a trajectory onto the true ones. Raises TrajectoryError."""
    est, true = read_pair(estimate, truth)
    i, poses = truth_at(est.t_ns, true, MAX_DIFFERENCE_NS)
    if len(i) < 3:
        raise TrajectoryError(f"{estimate} against {truth}: fewer than three poses have a true pose at their time")
    a, b = est.T_w_b[i, :2, 3], poses[:, :2, 3]
    s, t = a - a.mean(axis=0), b - b.mean(axis=0)
    yaw = float(np.arctan2((s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0]).sum(), (s * t).sum()))
    T = planar(0.0, 0.0, float(np.degrees(yaw)))
    T[:2, 2] = b.mean(axis=0) - T[:2, :2] @ a.mean(axis=0)
    return T


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="kiteline grid eval",
        description="Precision and recall of an occupancy grid for path planning: roads drawn on EST that are free in "
        "TRUE, and the other way round. Unknown cells are not free.",
    )
    parser.add_argument("est", type=Path, metavar="EST.yaml")
    parser.add_argument("true", type=Path, metavar="TRUE.yaml")
    parser.add_argument(
        "--transform",
        type=float,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("X", "Y", "YAW"),
        help="motion that maps EST onto TRUE: metres and degrees",
    )
    parser.add_argument(
        "--paths",
        nargs=2,
        metavar=("EST", "GT"),
        help="trajectory of the flight and the true one, as kiteline eval reads them: the motion between them is taken "
        "instead of --transform",
    )
    parser.add_argument(
        "--align",
        action="store_true",
        help="fit rotation and translation of EST to the obstacles of TRUE, within 0.8 m and 8 degrees of --transform "
        "or --paths",
    )
    default = GridEvalConfig()
    parser.add_argument("--draws", type=int, default=default.draws)
    parser.add_argument("--nodes", type=int, default=default.nodes)
    parser.add_argument("--opening", type=int, default=default.opening_cells, metavar="CELLS")
    parser.add_argument("--robot-radius", type=float, default=default.robot_radius_m, metavar="M")
    parser.add_argument("--seed", type=int, default=default.seed)
    parser.add_argument("--plot", type=Path, metavar="F.png", help="draw estimate, truth and difference")
    parser.add_argument("--json", action="store_true", help="print JSON; it always does")
    return parser


def main(argv: list[str]) -> int:
    """Run `kiteline grid eval`, which prints one JSON object; the exit status.

    Raises GridFileError and TrajectoryError.
    """
    parser, default = _parser(), GridEvalConfig()
    args = parser.parse_args(argv)
    if args.draws < 1 or args.nodes < 2 or args.opening < 0 or not args.robot_radius >= 0.0:
        parser.error("expected at least 1 draw, 2 nodes, and no negative opening or radius")
    if args.seed < 0 or not np.isfinite(args.transform).all():
        parser.error("expected a seed that is not negative, and a transform of finite numbers")
    config = GridEvalConfig(args.draws, args.nodes, default.spacing, args.opening, args.robot_radius, args.seed)
    est, true, T_true_est = read_grid(args.est), read_grid(args.true), planar(*args.transform)
    if args.paths is not None:
        T_true_est = between_paths(*args.paths)
    if args.align:
        T_true_est = aligned(est, true, T_true_est)
    elif args.paths is None and args.transform == parser.get_default("transform"):
        _warn_of_frames(est, true)
    found = score(est, true, T_true_est, config)
    if args.plot is not None:
        draw_comparison(args.plot, est, true, T_true_est, config)
    result = {
        "precision_percent": _rounded(found.precision),
        "recall_percent": _rounded(found.recall),
        "roads": {"estimate": found.precision_roads, "truth": found.recall_roads},
        "free_m2": {"estimate": round(found.free_est_m2, 3), "truth": round(found.free_true_m2, 3)},
        "transform": {
            "x_m": round(float(T_true_est[0, 2]), 4),
            "y_m": round(float(T_true_est[1, 2]), 4),
            "yaw_deg": round(float(np.degrees(np.arctan2(T_true_est[1, 0], T_true_est[0, 0]))), 3),
        },
        "draws": config.draws,
        "nodes": config.nodes,
        "opening_cells": config.opening_cells,
        "robot_radius_m": config.robot_radius_m,
        "seed": config.seed,
    }
    print(json.dumps(result, indent=2))
    return 0


def _warn_of_frames(est: GridFile, true: GridFile) -> None:
    """Say so if the obstacles of two grids, taken as they are, do not lie near each other."""
    share = share_near(est, true, np.eye(3), _NEAR_M)
    if share < _LEAST_NEAR:
        print(
            f"kiteline: {share:.0%} of the estimate's obstacles lie within {_NEAR_M:g} m of true ones: the grids seem "
            "to lie in two frames; --paths EST GT takes the motion between them from two trajectories, --align "
            "refines it", file=sys.stderr,
        )  # fmt: skip


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 3)

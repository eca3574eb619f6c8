"""`kiteline eval EST GT`: compare a trajectory with ground truth."""

import argparse
import importlib
import json

from kiteline_core.frame import Trajectory
from kiteline_lab.evaluation import metrics
from kiteline_lab.evaluation.metrics import Evaluation, Relative, TrajectoryAlignment
from kiteline_lab.evaluation.trajectories import TrajectoryError, read_pair

_MOST_DIFFERENCE_S = 1e6  # which nanoseconds hold by far


def evaluate_files(
    estimate: str,
    truth: str,
    alignment: TrajectoryAlignment = TrajectoryAlignment.SE3,
    max_difference_ns: int = metrics.MAX_DIFFERENCE_NS,
    plot: str = "",
) -> Evaluation:
    """Compare two trajectory files. plot: a PNG to draw, empty for none. Raises TrajectoryError."""
    est, true = read_pair(estimate, truth)
    try:
        result = metrics.evaluate(est, true, alignment, max_difference_ns)
    except ValueError as error:
        raise TrajectoryError(f"{estimate} against {truth}: {error}") from error
    if plot:
        from kiteline_lab.plots.plot import Line, plot_trajectories

        matched = metrics.match(est, true, alignment, max_difference_ns)
        line = Line("estimate", Trajectory(matched.t_ns, matched.estimate))
        title = f"ATE {result.ate_m.rmse:.3f} m rmse over {result.path_m:.0f} m ({_fitted(result)})"
        plot_trajectories(plot, [line], true, title)
    return result


def _fitted(e: Evaluation) -> str:
    """How the estimate was aligned with the truth."""
    return {
        "se3": "rotation and translation fitted",
        "sim3": f"scale {e.scale:.4f} fitted too",
        "origin": "on the first pose",
    }[e.alignment]


def table(e: Evaluation) -> str:
    """The errors as a few lines of text."""
    a = e.ate_m
    lines = [
        f"poses      {e.matched} of {e.estimated} matched; {e.coverage:.1%} of the time covered; path {e.path_m:.1f} m",
        f"ATE        rmse {a.rmse:.4f} m   mean {a.mean:.4f} m   max {a.max:.4f} m   ({_fitted(e)})",
        _relative_line("RPE/frame", e.rpe_frame),
        _relative_line("RPE/s", e.rpe_second),
    ]
    if e.kitti is None:
        lines.append(f"KITTI      needs at least {metrics.KITTI_LENGTHS_M[0]:.0f} m of path")
    else:
        k = e.kitti
        lines.append(
            f"KITTI      t_rel {k.t_rel_percent:.3f} %   r_rel {k.r_rel_deg_per_100m:.3f} deg/100 m   "
            f"({k.segments} segments)"
        )
    return "\n".join(lines)


def _relative_line(name: str, r: Relative | None) -> str:
    if r is None:
        return f"{name:10} no pair of poses that far apart"
    t, a = r.translation_m, r.rotation_deg
    return (
        f"{name:10} rmse {1e3 * t.rmse:.2f} mm   mean {1e3 * t.mean:.2f} mm   max {1e3 * t.max:.2f} mm   |   "
        f"rmse {a.rmse:.4f} deg   mean {a.mean:.4f} deg   max {a.max:.4f} deg"
    )


def parser() -> argparse.ArgumentParser:
    """The arguments of `kiteline eval`."""
    p = argparse.ArgumentParser(
        prog="kiteline eval",
        description="Compare a trajectory with ground truth. Either may be a TUM file (t x y z qx qy qz qw), KITTI "
        "poses (12 columns) or EuRoC's data.csv; the truth may also be a recording that holds it (mcap:FILE, "
        "euroc:DIR, a folder). KITTI poses take their times from times.txt beside them; without it, from the other "
        "trajectory "
        "in order when both have as many poses, else they stand for 10 Hz from 0.",
    )
    p.add_argument("estimate", metavar="EST", help="the estimated trajectory")
    p.add_argument("truth", metavar="GT", help="ground truth")
    how = p.add_mutually_exclusive_group()
    how.add_argument("--scale", action="store_true", help="fit scale as well (Sim3): for a monocular camera")
    how.add_argument("--origin", action="store_true", help="align the first poses instead of the best fit")
    p.add_argument(
        "--max-difference",
        type=float,
        default=metrics.MAX_DIFFERENCE_NS / 1e9,
        metavar="S",
        help="ground truth below 20 Hz: largest time between two poses that are compared (default %(default)s s)",
    )
    p.add_argument("--json", action="store_true", help="print JSON instead of the table")
    p.add_argument("--plot", metavar="F.png", help="draw both from above, and height and error over time")
    return p


def main(argv: list[str]) -> int:
    """Run `kiteline eval`; the exit status."""
    p = parser()
    a = p.parse_args(argv)
    if not 0.0 <= a.max_difference <= _MOST_DIFFERENCE_S:
        p.error(f"--max-difference {a.max_difference:g}: expected seconds from 0 to {_MOST_DIFFERENCE_S:g}")
    if a.plot:
        importlib.import_module("matplotlib")  # an extra that is missing is told at once
    alignment = (
        TrajectoryAlignment.SIM3 if a.scale else TrajectoryAlignment.ORIGIN if a.origin else TrajectoryAlignment.SE3
    )
    result = evaluate_files(a.estimate, a.truth, alignment, round(a.max_difference * 1e9), a.plot or "")
    print(json.dumps(result.as_dict(), indent=2) if a.json else table(result))
    return 0

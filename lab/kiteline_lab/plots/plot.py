"""Draw trajectories: from above, height over time, and the error over time if ground truth is known."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import Trajectory
from kiteline_lab.evaluation.metrics import TrajectoryAlignment, match, position_errors, truth_at
from kiteline_lab.outputs.out_file import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Distinct for colour-blind readers too (Okabe and Ito, 2008).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_DASHES: tuple[Any, ...] = ("-", (0, (4, 2)), "-.", ":")  # alternate, so that a line shows through one that covers it
_LONGEST_TITLE = 100  # letters that fit above the panels
TRUTH_COLOUR = "#9a9a9a"
INK = "#333333"


@dataclass(frozen=True, slots=True)
class Line:
    """One estimated trajectory and its name in the legend. own_unit: its lengths are in no metres."""

    name: str
    trajectory: Trajectory
    own_unit: bool = False


def can_plot() -> bool:
    """True if matplotlib, which the plain install leaves out, is here. Does not import it."""
    return importlib.util.find_spec("matplotlib") is not None


def plot_trajectories(
    path: str | Path, lines: Sequence[Line], truth: Trajectory | None = None, title: str = "", *, align: bool = False
) -> None:
    """Write a PNG, whatever the name ends in. truth: drawn in grey, and adds a panel of errors.

    align: first align each line with the truth by rotation and translation, and by scale if it has a unit of its own
    (as ATE does), if enough poses match.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = [_aligned(line, truth) for line in lines] if align and truth is not None else list(lines)
    across, along, up, sign = _axes(truth if truth is not None else drawn[0].trajectory if drawn else None)
    start_ns = min([int(line.trajectory.t_ns[0]) for line in drawn if len(line.trajectory.t_ns)], default=0)

    figure = Figure(figsize=(11.0, 5.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    unit = "own unit of length" if truth is None and drawn and all(line.own_unit for line in drawn) else "m"
    top, height, error = _panels(figure, unit, with_error=truth is not None)
    top.set_xlabel("xyz"[across], fontsize=9, color=INK)
    top.set_ylabel("xyz"[along], fontsize=9, color=INK)
    if truth is not None and len(truth.t_ns):
        shown = _during(truth, drawn)
        p = shown.T_w_b[:, :3, 3]
        top.plot(p[:, across], p[:, along], color=TRUTH_COLOUR, lw=2.6, label="truth", zorder=1)
        height.plot((shown.t_ns - start_ns) / 1e9, sign * p[:, up], color=TRUTH_COLOUR, lw=2.2, zorder=1)
    errors: list[tuple[F64, F64, dict[str, Any]]] = []
    for i, line in enumerate(drawn):
        dashes = _DASHES[(i % 2 + 2 * (i // len(COLOURS))) % len(_DASHES)]
        style = {"color": COLOURS[i % len(COLOURS)], "ls": dashes}
        t_s = (line.trajectory.t_ns - start_ns) / 1e9
        p = line.trajectory.T_w_b[:, :3, 3]
        if len(p) == 0:
            continue
        _, path_xy = _with_gaps(t_s, p[:, [across, along]])
        top.plot(path_xy[:, 0], path_xy[:, 1], lw=1.3, label=_as_text(line.name), zorder=2, **style)
        top.plot(p[:1, across], p[:1, along], "o", color=style["color"], ms=5, zorder=3)
        height.plot(*_with_gaps(t_s, sign * p[:, up]), lw=1.2, zorder=2, **style)
        if error is not None and truth is not None:
            i_est, true = truth_at(line.trajectory.t_ns, truth)
            distance = np.linalg.norm(p[i_est] - true[:, :3, 3], axis=1)
            errors.append((t_s[i_est], distance, style))
    if error is not None:
        _draw_errors(error, errors)
    if title:
        short = title if len(title) <= _LONGEST_TITLE else f"…{title[-_LONGEST_TITLE:]}"
        figure.suptitle(_as_text(short), x=0.01, ha="left", color=INK, fontsize=12, fontweight="bold")
    if top.get_legend_handles_labels()[0]:
        top.legend(frameon=False, fontsize=9, labelcolor=INK)
    png = io.BytesIO()
    figure.savefig(png, format="png", metadata={"Software": None})  # no version inside: equal runs give equal files
    write_whole(Path(path), png.getvalue())


def _as_text(name: str) -> str:
    """A name of any file as matplotlib draws it: no formula between dollars, no bytes that are no letters."""
    return name.encode(errors="backslashreplace").decode().replace("$", r"\$")


def _panels(figure: Figure, unit: str, *, with_error: bool) -> tuple[Axes, Axes, Axes | None]:
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    top = figure.add_subplot(grid[:, 0])
    height = figure.add_subplot(grid[0, 1] if with_error else grid[:, 1])
    error = figure.add_subplot(grid[1, 1], sharex=height) if with_error else None
    top.set_aspect("equal", adjustable="datalim")
    _style(top, f"from above, {unit}; dot: start", "")
    _style(height, f"height, {unit}", "" if with_error else "time, s")
    if error is not None:
        _style(error, "", "time, s")
    return top, height, error


def _draw_errors(axes: Axes, errors: Sequence[tuple[F64, F64, dict[str, Any]]]) -> None:
    """Draw distances in mm, cm or m, by the largest of them. errors: times in s, distances in m, and how to draw."""
    largest_m = max((float(off.max()) for _, off, _ in errors if len(off)), default=0.0)
    per_m, unit = (1e3, "mm") if largest_m < 0.1 else (1e2, "cm") if largest_m < 1.0 else (1.0, "m")
    for t_s, off, style in errors:
        axes.plot(*_with_gaps(t_s, per_m * off), lw=1.2, **style)
    axes.set_title(f"distance to the truth, {unit}", loc="left", fontsize=10, color=INK)
    axes.set_ylim(bottom=0.0)


def _style(axes: Axes, title: str, x: str) -> None:
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_xlabel(x, fontsize=9, color=INK)
    axes.grid(True, color="#e6e6e6", lw=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8, color="#cccccc", labelcolor=INK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#cccccc")


def _aligned(line: Line, truth: Trajectory) -> Line:
    try:
        matched = match(line.trajectory, truth, TrajectoryAlignment.SIM3 if line.own_unit else TrajectoryAlignment.SE3)
    except ValueError:
        return line
    told = f"ATE {_length(position_errors(matched))}" + (", scale fitted" if line.own_unit else "")
    return Line(f"{line.name}  ({told})", Trajectory(matched.t_ns, matched.estimate), line.own_unit)


def _length(errors: F64) -> str:
    rmse = float(np.sqrt((errors**2).mean()))
    if rmse >= 1.0:
        return f"{rmse:.2f} m"
    return f"{1000 * rmse:.1f} mm" if rmse < 0.01 else f"{1000 * rmse:.0f} mm"


def _axes(reference: Trajectory | None) -> tuple[int, int, int, float]:
    """Columns drawn across, along and up, and the sign of up: z up, or y down for camera poses such as KITTI's."""
    if reference is not None and len(reference.t_ns):
        extent = np.ptp(reference.T_w_b[:, :3, 3], axis=0)
        if float(np.mean(reference.T_w_b[:, 1, 1])) > 0.8 and extent[1] < 0.5 * extent[2]:
            return 0, 2, 1, -1.0
    return 0, 1, 2, 1.0


def _during(truth: Trajectory, lines: Sequence[Line]) -> Trajectory:
    """The part of the truth within the time of the lines, so that a short estimate is not drawn tiny."""
    times = [line.trajectory.t_ns for line in lines if len(line.trajectory.t_ns)]
    if not times:
        return truth
    inside = (truth.t_ns >= min(t[0] for t in times)) & (truth.t_ns <= max(t[-1] for t in times))
    return replace(truth, t_ns=truth.t_ns[inside], T_w_b=truth.T_w_b[inside]) if inside.any() else truth


def _with_gaps(t_s: F64, values: F64) -> tuple[F64, F64]:
    """Insert a NaN into each long gap, so that no line is drawn across missing poses."""
    steps = np.diff(t_s)
    if len(steps) == 0:
        return t_s, values
    gaps = np.flatnonzero(steps > 5.0 * np.median(steps)) + 1
    return np.insert(t_s, gaps, t_s[gaps - 1]), np.insert(values, gaps, np.nan, axis=0)

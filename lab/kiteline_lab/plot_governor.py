"""Figure: CPU against error, with the governor and without it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kiteline_lab.governed import Governed


def plot_governor(path: Path, flights: Sequence[Governed], title: str) -> None:
    """Draw flights under limits; the ones without a limit are the reference."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    error, given = figure.subplots(1, 2)
    for governor, colour, label in ((True, "#1f77b4", "governor on"), (False, "#d62728", "governor off")):
        chosen = sorted((f for f in flights if f.percent and f.governor is governor), key=lambda f: f.percent)
        percent = [f.percent for f in chosen]
        error.plot(percent, [1000.0 * f.ate_m for f in chosen], "o-", color=colour, label=label)
        given.plot(percent, [100.0 * f.tracked / f.frames for f in chosen], "o-", color=colour, label=label)
        given.plot(percent, [100.0 * f.peak / f.percent for f in chosen], "x--", color=colour, alpha=0.6,
                   label=f"{label}: dearest second, % of budget")  # fmt: skip
    for flight in flights:
        if not flight.percent:
            error.axhline(1000.0 * flight.ate_m, color="0.6", linewidth=0.8, label="no limit")
    error.set(xlabel="budget, % of one core", ylabel="ATE live, mm", yscale="log")
    given.set(xlabel="budget, % of one core", ylabel="%", title="frames tracked", ylim=(0.0, None))
    error.set_title(title)
    for axes in (error, given):
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=110)

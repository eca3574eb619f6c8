"""Figure: CPU against error, with the governor and without it."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from kiteline_bench.harness.limited_cpu import LimitedFlight

_STYLES = ((True, "#1f77b4", "o-", "governor on"), (False, "#d62728", "s--", "governor off: the newest frame wins"))


def plot_governor(path: Path, flights: Sequence[LimitedFlight], title: str) -> None:
    """Draw flights under limits; the one without a limit is the reference."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    free = next((flight for flight in flights if not flight.percent), flights[0])
    figure = Figure(figsize=(10.0, 3.9), layout="constrained")
    FigureCanvasAgg(figure)
    error, given, busiest = figure.subplots(1, 3)
    parts: tuple[tuple[Any, str, Callable[[LimitedFlight], float]], ...] = (
        (error, "ATE live, mm", lambda f: 1000.0 * f.ate_m),
        (given, "frames with a pose, %", lambda f: 100.0 * f.tracked / f.frames),
        (busiest, "busiest second, % of the budget", lambda f: 100.0 * f.peak / f.percent),
    )
    for axes, label, value in parts:
        for governor, colour, style, name in _STYLES:
            chosen = sorted((f for f in flights if f.percent and f.governor is governor), key=lambda f: f.percent)
            axes.plot([f.percent for f in chosen], [value(f) for f in chosen], style, color=colour, label=name)
        axes.set(xlabel="budget, % of one core", ylabel=label, xlim=(0.0, 1.1 * free.load))
        axes.grid(True, alpha=0.3)
    error.axhline(1000.0 * free.ate_m, color="0.5", linewidth=1.0, label="no limit")
    error.set_yscale("log")
    errors_mm = [1000.0 * flight.ate_m for flight in flights if math.isfinite(flight.ate_m)] or [1.0]
    error.set_ylim(min(errors_mm) / 1.6, max(errors_mm) * 1.6)
    given.set_ylim(0.0, 105.0)
    busiest.axhline(100.0, color="0.5", linewidth=1.0)
    busiest.set_ylim(0.0, max(110.0, 1.1 * busiest.get_ylim()[1]))
    figure.legend(*error.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle(f"{title}: {free.load:.1f} % of a core without a limit", fontsize=10)
    figure.savefig(path, dpi=110)

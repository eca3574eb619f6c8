"""Figure of throttled flights: errors and frames with a pose by share of a core, and paths at the smallest share."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from kiteline_bench.papers.throttled import MODES, Throttled, medians
from kiteline_core.arrays import F64
from kiteline_lab.plots.plot import COLOURS, TRUTH_COLOUR

_MARKERS = ("^", "s", "o", "D")


def plot_throttled(
    path: Path, flown: Mapping[str, Mapping[tuple[str, float], Sequence[Throttled]]], percents: Sequence[float]
) -> None:
    """Draw a column for each recording. flown: by recording, then flights of all starts by mode and percent."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FormatStrFormatter, NullLocator

    figure = Figure(figsize=(4.0 * len(flown), 8.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, len(flown), squeeze=False)
    for column, (what, flights) in enumerate(flown.items()):
        error, posed, top = axes[:, column]
        truth = _longest_truth([found[0] for found in flights.values()])
        plane = np.sort(np.argsort(np.ptp(truth, axis=0))[1:])  # the two axes along which it moves most
        top.plot(*truth[:, plane].T, color=TRUTH_COLOUR, lw=2.4)
        for k, (mode, name) in enumerate(MODES.items()):
            style = {"color": COLOURS[k], "marker": _MARKERS[k], "label": name, "lw": 1.4, "ms": 4}
            rows = [flights[mode, percent] for percent in percents]
            error.plot(percents, [medians(found).max_abs_m for found in rows], **style)
            share = [100.0 * (1.0 - float(np.mean([f.missing for f in found]))) for found in rows]
            posed.plot(percents, share, **style)
            live = flights[mode, min(percents)][0].live
            if live is not None:
                top.plot(*live.estimate[:, plane, 3].T, color=COLOURS[k], lw=1.0, marker=".", ms=2)
        for panel in (error, posed):
            panel.set_xscale("log")
            panel.set_xticks(percents, [f"{percent:g}" for percent in percents])
            panel.xaxis.set_minor_locator(NullLocator())
            panel.set_xlabel("% of a core")
            panel.grid(True, alpha=0.3)
        error.set_yscale("log")
        error.set(
            ylabel="largest absolute error, m", title=what, ylim=_limits([f for k in flights.values() for f in k])
        )
        error.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        error.yaxis.set_minor_locator(NullLocator())
        posed.set(ylabel="frames with a pose, %", ylim=(0.0, 105.0))
        top.set(title=f"live poses at {min(percents):g} % of a core, m", aspect="equal", adjustable="datalim")
        top.title.set_fontsize(9)
        error.title.set_fontsize(9)
        top.grid(True, alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9)
    figure.savefig(path, dpi=110)


def _limits(flights: Sequence[Throttled]) -> tuple[float, float]:
    """Limits of the errors' axis: at least two decades, so that chance does not look like much."""
    errors = [flight.errors.max_abs_m for flight in flights if np.isfinite(flight.errors.max_abs_m)] or [1.0]
    low, high = float(np.log10(min(errors))), float(np.log10(max(errors)))
    more = max(0.2, 1.0 - (high - low) / 2.0)
    return 10.0 ** (low - more), 10.0 ** (high + more)


def _longest_truth(flights: Sequence[Throttled]) -> F64:
    """True positions (n,3) of the flight with most poses."""
    paths = [flight.live.truth[:, :3, 3] for flight in flights if flight.live is not None]
    return max(paths, key=len, default=np.zeros((1, 3)))

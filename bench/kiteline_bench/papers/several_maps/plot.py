"""Figure: the keyframes of all robots in one world, beside the true paths."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kiteline_core.arrays import F64

_COLUMNS = 4
_COLOURS = ("#1f77b4", "#2ca02c", "#d62728", "#9467bd")


class Drawn(NamedTuple):
    """An experiment as drawn. found, true: positions (n,3) of each robot, in m."""

    title: str
    found: Sequence[F64]
    true: Sequence[F64]


def plot_experiments(path: Path, experiments: Sequence[Drawn]) -> None:
    """Draw each experiment from above, in the plane in which its path is widest."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = [o for o in experiments if o.found]
    rows = max(1, -(-len(drawn) // _COLUMNS))
    figure = Figure(figsize=(3.4 * _COLUMNS, 3.3 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    for k, o in enumerate(drawn):
        axes = figure.add_subplot(rows, _COLUMNS, k + 1)
        widest = np.sort(np.argsort(np.ptp(np.concatenate(o.true), axis=0))[1:])
        for i, (found, true) in enumerate(zip(o.found, o.true, strict=True)):
            axes.plot(*true[:, widest].T, "--", color="0.6", linewidth=1.0, label="truth" if i == 0 else None)
            axes.plot(*found[:, widest].T, "-", color=_COLOURS[i % len(_COLOURS)], linewidth=1.6, label=f"robot {i}")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(o.title, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize=6)
    figure.savefig(path, dpi=100)

"""Figure: memory of the grid and CPU of its updates, as figure 67 of the thesis."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def plot_updates(path: Path, costs: Mapping[str, tuple[F64, F64]], their_mb: float) -> None:
    """Draw the CPU in ms and the memory in MB of each update, by title; their_mb: slope of the thesis's memory."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    memory, cpu = figure.subplots(1, 2)
    longest = max((len(mb) for _, mb in costs.values()), default=1)
    for title, (put_ms, mb) in costs.items():
        memory.plot(np.arange(1, len(mb) + 1), mb, label=title)
        cpu.plot(np.arange(1, len(put_ms) + 1), put_ms, linewidth=0.9, label=title)
    memory.plot(
        [0, longest], [0.0, their_mb * longest], "--", color="0.4", label=f"Segfloor: {their_mb:g} MB an update"
    )
    memory.set(xlabel="updates", ylabel="memory of tiles and scans, MB")
    cpu.set(xlabel="updates", ylabel="CPU of drawing on the base, ms", yscale="log")
    for axes in (memory, cpu):
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=100)

"""Figures: the scenes from above; memory of the grid and CPU of its updates, as figure 67 of the thesis."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64
from kiteline_hw.sim.truth.occupancy import TrueGrid


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


def plot_scenes(path: Path, plans: Mapping[str, tuple[TrueGrid, F64]]) -> None:
    """Draw true occupancy from above, and the way (n,2) through it, by title."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (title, (grid, way)) in zip(figure.subplots(1, len(plans), squeeze=False)[0], plans.items(), strict=True):
        rows, columns = grid.image.shape
        left, low = grid.corner
        extent = (left, left + columns * grid.cell_m, low, low + rows * grid.cell_m)
        axes.imshow(grid.image, cmap="gray", origin="lower", extent=extent, vmin=0, vmax=255)
        axes.plot(*way.T, color="#d62728", linewidth=1.2)
        axes.set_title(title, fontsize=9)
        axes.tick_params(labelsize=7)
    figure.savefig(path, dpi=100)

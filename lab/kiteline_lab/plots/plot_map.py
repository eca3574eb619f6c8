"""Draw the map of a flight from above: occupancy grid, labelled points and the path of each agent.

python -m kiteline_lab.plots.plot_map OUT [--png F.png], where OUT is a folder of `kiteline fly`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kiteline_core.errors import KitelineError
from kiteline_lab.evaluation import trajectories
from kiteline_lab.evaluation.grid_eval import GridFile, GridFileError, read_grid
from kiteline_lab.evaluation.trajectories import TrajectoryError
from kiteline_lab.plots.plot import COLOURS, INK

if TYPE_CHECKING:
    from matplotlib.axes import Axes

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

UNKNOWN_COLOUR, FREE_COLOUR, SOLID_COLOUR = "#e9e8e4", "#ffffff", "#3a3936"
LABELS = (("points", "#a9a8a2"), ("ground points", "#3f9a6b"), ("obstacle points", "#d0622f"))  # by label
_ABOUT = (__doc__ or "").split("\n\n")[0]
_MARGIN_M = 0.5  # m around what was mapped
_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "ushort": "<u2", "uint": "<u4", "int": "<i4", "short": "<i2"}


class MapFileError(KitelineError):
    """A map that cannot be read; the text says what was expected."""


@dataclass(frozen=True, slots=True)
class MapPoints:
    """xyz: (n,3) m in w. label: (n,) 0 unlabelled, 1 ground, 2 obstacle."""

    xyz: F64
    label: U8


def read_map_ply(path: Path) -> MapPoints:
    """Read a map.ply as the base writes it (binary, little endian, vertices first). Raises MapFileError."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise MapFileError(f"{path}: {e.strerror or e}") from None
    head, mark, body = data.partition(b"end_header\n")
    words = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not mark or words[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise MapFileError(f"{path}: no binary little-endian PLY file")
    try:
        n = next(int(w[2]) for w in words if w[:2] == ["element", "vertex"])
        kind = np.dtype([(w[2], _TYPES[w[1]]) for w in words if w[:1] == ["property"]])
        vertex = np.frombuffer(body, kind, n)
        xyz = np.stack([vertex[a] for a in "xyz"], axis=1).astype(np.float64)
        return MapPoints(xyz, np.asarray(vertex["label"], np.uint8))
    except (StopIteration, KeyError, IndexError, ValueError) as e:
        raise MapFileError(f"{path}: expected vertices with x, y, z and label ({e})") from None


def plot_map(out: Path, png: Path, title: str = "") -> None:
    """Draw the folder `out` of a flight to a PNG. Raises MapFileError, GridFileError, TrajectoryError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    points = read_map_ply(out / "base" / "map.ply")
    grid = read_grid(out / "base" / "grid.yaml")
    paths = [trajectories.read(str(file)).trajectory.T_w_b[:, :3, 3] for file in _tracks(out)]
    x0, y0, x1, y1 = _extent(points, grid, paths)
    wide, tall = x1 - x0, y1 - y0
    inch = 8.6 / max(wide, tall)
    figure = Figure(figsize=(max(wide * inch, 3.6) + 0.9, max(tall * inch, 2.6) + 1.2), dpi=140, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _style(axes)
    _draw_grid(axes, grid)
    for label, (name, colour) in enumerate(LABELS):
        p = points.xyz[points.label == label]
        if len(p):
            axes.plot(
                p[:, 0], p[:, 1], "o", ms=1.9, mew=0, color=colour, alpha=0.65, label=name, zorder=2, rasterized=True
            )
    for i, path in enumerate(paths):
        colour = COLOURS[i % len(COLOURS)]
        axes.plot(path[:, 0], path[:, 1], color="white", lw=3.2, zorder=3, solid_capstyle="round")
        axes.plot(path[:, 0], path[:, 1], color=colour, lw=1.6, label=f"agent {i}", zorder=4, solid_capstyle="round")
        axes.plot(*path[0, :2], "o", ms=6, color="white", mec=colour, mew=1.6, zorder=5)
        axes.plot(*path[-1, :2], "o", ms=6, color=colour, mec="white", mew=1.2, zorder=5)
    axes.set_xlim(x0, x1)
    axes.set_ylim(y0, y1)
    if title:
        axes.set_title(title, loc="left", fontsize=11, color=INK, fontweight="bold")
    style = {"frameon": False, "fontsize": 9, "labelcolor": INK, "handlelength": 1.4, "columnspacing": 1.6}
    legend = figure.legend(loc="outside lower center", ncols=5, **style)
    for handle in legend.legend_handles:
        if handle is not None and hasattr(handle, "set_markersize") and handle.get_label() in dict(LABELS):
            handle.set_markersize(5)
            handle.set_alpha(1.0)
    png.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(png, metadata={"Software": None})  # no version inside: equal runs give equal files


def _tracks(out: Path) -> list[Path]:
    """The agents' refined trajectories by number; without empty files (no frame tracked)."""
    found = [p for p in (out / "base").glob("agent*.tum") if p.stem[5:].isdecimal() and p.stat().st_size]
    return sorted(found, key=lambda p: int(p.stem[5:]))


def _extent(points: MapPoints, grid: GridFile, paths: Sequence[F64]) -> tuple[float, float, float, float]:
    """Bounds of known cells and paths, or of 96 % of the points if there are neither."""
    corners = [path[:, :2] for path in paths]
    rows, columns = np.nonzero(grid.state >= 0)
    if len(rows):
        corners.append(np.stack([columns, rows], axis=1) * grid.cell_m + grid.origin[:2])
    if not corners and len(points.xyz):
        corners.append(np.percentile(points.xyz[:, :2], [2, 98], axis=0))
    if not corners:
        return -1.0, -1.0, 1.0, 1.0
    every = np.concatenate(corners)
    (x0, y0), (x1, y1) = every.min(axis=0) - _MARGIN_M, every.max(axis=0) + _MARGIN_M
    return float(x0), float(y0), float(x1), float(y1)


def _draw_grid(axes: Axes, grid: GridFile) -> None:
    from matplotlib.colors import ListedColormap

    rows, columns = grid.state.shape
    x, y, _ = grid.origin
    image = np.select([grid.state == 0, grid.state == 100], [1, 2], 0)
    axes.imshow(
        image, cmap=ListedColormap([UNKNOWN_COLOUR, FREE_COLOUR, SOLID_COLOUR]), vmin=0, vmax=2, origin="lower",
        extent=(x, x + columns * grid.cell_m, y, y + rows * grid.cell_m), interpolation="nearest", zorder=1,
    )  # fmt: skip


def _style(axes: Axes) -> None:
    axes.set_facecolor(UNKNOWN_COLOUR)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m", fontsize=9, color=INK)
    axes.set_ylabel("y, m", fontsize=9, color=INK)
    axes.tick_params(labelsize=8, color="#cccccc", labelcolor=INK)
    for spine in axes.spines.values():
        spine.set_color("#cccccc")


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit status."""
    parser = argparse.ArgumentParser(prog="python -m kiteline_lab.plots.plot_map", description=_ABOUT)
    parser.add_argument("out", type=Path, metavar="OUT", help="a folder written by `kiteline fly --out`")
    parser.add_argument("--png", type=Path, help="default: OUT/map.png")
    parser.add_argument("--title", default="")
    args = parser.parse_args(argv)
    png = args.png or args.out / "map.png"
    try:
        plot_map(args.out, png, args.title)
    except (MapFileError, GridFileError, TrajectoryError) as e:
        print(f"plot_map: {e}", file=sys.stderr)
        return 2
    print(png)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

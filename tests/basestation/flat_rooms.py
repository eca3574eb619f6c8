"""Rooms of walls seen from above, cameras in them, and the column scans that they see."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ground.column_scan import ColumnScan

HEIGHT_M = 1.0  # of the camera above the ground


def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    """Four walls."""
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


ROOM = np.array(
    box(-4.0, -3.5, 4.0, 3.5) + box(-0.5, -0.5, 0.4, 0.6) + box(2.0, 2.0, 2.05, 2.05)
)  # with a box and a leg


def camera(x: float, y: float, heading: float, z: float = 0.0) -> F64:
    """T_w_c (4,4) of a level camera."""
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    return se3.from_rt(np.stack([np.cross(down, forward), down, forward], 1), np.array([x, y, z]))


def cast(walls: F64, x: float, y: float, azimuths: F64) -> F64:
    """Ranges (n,) to the nearest wall; inf without one."""
    d = np.stack([np.cos(azimuths), np.sin(azimuths)], 1)
    p, e = walls[:, :2] - [x, y], walls[:, 2:] - walls[:, :2]
    with np.errstate(all="ignore"):
        across = d[:, :1] * e[:, 1] - d[:, 1:] * e[:, 0]
        along = (p[:, 0] * e[:, 1] - p[:, 1] * e[:, 0]) / across
        place = (p[:, 0] * d[:, 1:] - p[:, 1] * d[:, :1]) / across
    return np.asarray(np.where((along > 0) & (place >= 0) & (place <= 1), along, np.inf).min(axis=1))


def scan_of(
    walls: F64, x: float, y: float, heading: float, columns: int = 84, wide: float = 1.5, noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> ColumnScan:  # fmt: skip
    """What a camera sees: the ground from 1.4 m on, and walls of all heights. noise: of ranges over their square."""
    azimuths = (np.arange(columns) + 0.5) / columns * wide - wide / 2
    r = cast(walls, x, y, azimuths + heading)
    if rng is not None:
        r = r + rng.normal(0.0, noise, columns) * np.where(np.isfinite(r), r, 0.0) ** 2
    seen = np.where(np.isfinite(r), r, 30.0)
    return ColumnScan(
        np.array([0.0, -1.0, 0.0]), float(azimuths[0]), wide / columns, np.where(seen > 1.4, 1.4, 0.0),
        np.where(seen > 1.4, seen, 0.0), r, np.where(np.isfinite(r), 7, 0).astype(np.uint8), seen, HEIGHT_M,
    )  # fmt: skip


def circle(n: int) -> list[tuple[float, float, float]]:
    """x, y, heading of a flight around the box, looking to and fro."""
    turn = 2 * np.pi * np.arange(n) / n
    return [(2 * np.cos(t), 2 * np.sin(t), t + np.pi / 2 + 0.6 * np.sin(5 * t)) for t in turn]

"""The grid of a real street, as a picture: the road free, parked cars and walls occupied."""

from pathlib import Path

import cv2
import numpy as np

from kiteline_bench.grid.flown import FlownGrid, fly_grid
from kiteline_bench.harness.bars import Bar, Bench, is_true
from kiteline_bench.harness.recording import load
from kiteline_core.arrays import F64, U8
from kiteline_lab.grids.files import FREE, OCCUPIED, UNKNOWN
from kiteline_lab.grids.picture import shaded

_STREET = "kitti_straight"
_HALF_LANE_M = 0.8  # beside the path, where the car itself drove
_IMAGE_PX = 900  # width of the picture


def run(bench: Bench) -> list[Bar]:
    """Fly the street, draw its grid, and check the way that was driven."""
    recording = load(f"kitti:{bench.source(_STREET)}")
    flight = fly_grid(bench, _STREET, recording)
    shares = _driven(flight)
    picture = _picture(flight, recording.items[len(recording.items) // 2].frame.left)
    name = "images/grid-kitti.png"
    folder = Path("docs") if Path("docs").is_dir() else bench.folder
    (folder / "images").mkdir(exist_ok=True)
    (folder / name).write_bytes(picture)
    bench.more.append(f"![The grid of a street, from above: driven upwards]({name})")
    return [
        is_true("the way that was driven: free", ">= 95 % of its known cells", shares[0] >= 0.95, f"{shares[0]:.1%}"),
        is_true("the way that was driven: known", ">= 80 %", shares[1] >= 0.8, f"{shares[1]:.1%}"),
        is_true("obstacles beside it", "> 20 m2", shares[2] > 20.0, f"{shares[2]:.0f} m2"),
    ]


def _path(flight: FlownGrid) -> F64:
    return flight.sparse.cameras[:, :2]


def _driven(flight: FlownGrid) -> tuple[float, float, float]:
    """Shares of the driven cells that are free, of the known ones, and known; and m2 of obstacles."""
    path, grid = _path(flight), flight.grid
    mask = np.zeros(grid.state.shape, np.uint8)
    cells = np.floor(grid.cells(path)).astype(np.int32)
    width = max(1, round(2.0 * _HALF_LANE_M / grid.cell_m))
    cv2.polylines(mask, [cells.reshape(-1, 1, 2)], False, 1, width)
    states = grid.state[mask > 0]
    known = states != UNKNOWN
    solid = float(np.count_nonzero(grid.state == OCCUPIED)) * grid.cell_m**2
    return float((states[known] == FREE).mean()) if known.any() else 0.0, float(known.mean()), solid


def _picture(flight: FlownGrid, image: U8) -> bytes:
    """The grid with the path in red, and an image of the street beside it, as PNG."""
    grid, path = flight.grid, _path(flight)
    rows, columns = np.nonzero(grid.state != UNKNOWN)
    low, high = np.array([columns.min(), rows.min()]) - 4, np.array([columns.max(), rows.max()]) + 5
    low = np.maximum(low, 0)
    drawn = shaded(grid.state)
    cells = np.floor(grid.cells(path)).astype(np.int32)
    cv2.polylines(drawn, [cells.reshape(-1, 1, 2)], False, (40, 40, 215), 2)
    drawn = np.ascontiguousarray(drawn[low[1] : high[1], low[0] : high[0]][::-1])
    if drawn.shape[0] > drawn.shape[1]:
        drawn = np.ascontiguousarray(np.rot90(drawn))
    scale = _IMAGE_PX / drawn.shape[1]
    size = _IMAGE_PX, max(1, round(drawn.shape[0] * scale))
    below = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)
    above = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    above = cv2.resize(above, (_IMAGE_PX, round(above.shape[0] * _IMAGE_PX / above.shape[1])))
    ok, data = cv2.imencode(".png", np.vstack([above, below]))
    assert ok
    return data.tobytes()

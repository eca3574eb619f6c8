"""Maps that kiteline writes load in nav2's map_server with every cell as it was meant, and read the same here."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid_view import dense, grid_files
from kiteline_basestation.grid.kept_scan import keep
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_core.geometry import se3
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_hw.sim.truth.occupancy import FREE, OCCUPIED, UNKNOWN, TrueGrid, write_grid
from kiteline_lab.grids.files import read_grid
from tests.lab.grids.nav2_loader import Nav2Error, load_as_nav2

STATES = {OCCUPIED: 100, FREE: 0, UNKNOWN: -1}


def true_grid() -> TrueGrid:
    image = np.random.default_rng(0).choice(np.array(list(STATES), np.uint8), (30, 40))
    return TrueGrid(image, np.array([-1.25, 0.4]), 0.05)


def test_true_grids_load(tmp_path: Path) -> None:
    grid = true_grid()
    write_grid(grid, tmp_path / "true_0.1-0.5.yaml")
    data, resolution, origin = load_as_nav2(tmp_path / "true_0.1-0.5.yaml")
    assert np.array_equal(data, np.vectorize(STATES.get)(grid.image))
    assert resolution == 0.05 and origin == [-1.25, 0.4, 0.0]
    assert np.array_equal(read_grid(tmp_path / "true_0.1-0.5.yaml").state, data)


def test_grids_of_the_base_load(tmp_path: Path) -> None:
    n, step = 40, 0.03
    azimuth = (np.arange(n) - 0.5 * (n - 1)) * step
    obstacle = np.where(azimuth > 0.2, 2.0, np.inf)
    free = np.where(azimuth > 0.2, 1.9, 3.0)
    scan = ColumnScan(
        np.array([0.0, -1.0, 0.0]), float(azimuth[0]), step, np.full(n, 1.0), free, obstacle,
        np.where(azimuth > 0.2, 3, 0).astype(np.uint8), free.copy(), 1.2,
    )  # fmt: skip
    config = replace(GridConfig(), ground_m=0.0)
    kept = keep(config, scan, 50.0)
    assert kept is not None
    grid = ScanGrid(config)
    for k in range(3):
        level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        grid.put(k, kept, se3.from_rt(level, np.array([-0.7, 12.3, 1.2])))
    files = grid_files(grid)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    data, resolution, origin = load_as_nav2(tmp_path / "grid.yaml")
    cells, corner, cell_m = dense(grid, grid.main_storey())
    assert np.array_equal(data, np.where(cells > 0, 100, cells)) and resolution == cell_m == 0.05
    assert np.allclose(origin, [*corner, 0.0], atol=1e-6)
    assert {-1, 0, 100} == set(np.unique(data).tolist())
    own = read_grid(tmp_path / "grid.yaml")
    assert np.array_equal(own.state, data)
    column, row = np.floor(
        own.cells(np.array([[-0.7 + 1.9 * np.cos(0.4) + 0.08, 12.3 + 2.0 * np.sin(0.4)]]))[0]
    ).astype(int)
    assert 100 in data[row - 2 : row + 3, column - 2 : column + 3], "the obstacle is ahead and to the left"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("free_thresh: 0.196", "free_thresh: 0.7"),
        ("negate: 0\n", ""),
        ("occupied_thresh: 0.65", "occupied_thresh: high"),
        ("mode: trinary", "mode: ternary"),
        ("0.0]", "0.0, 0.0]"),
        ("image: t.pgm", "image: other.pgm"),
    ],
)
def test_the_rules_refuse_what_map_server_refuses(tmp_path: Path, old: str, new: str) -> None:
    text = write_grid(true_grid(), tmp_path / "t.yaml").read_text()
    load_as_nav2(tmp_path / "t.yaml")
    assert old in text
    (tmp_path / "t.yaml").write_text(text.replace(old, new))
    with pytest.raises(Nav2Error):
        load_as_nav2(tmp_path / "t.yaml")


def test_unknown_cells_are_lost_by_the_thresholds_that_map_saver_proposes(tmp_path: Path) -> None:
    """205 is 0.196 occupied: with a free_thresh of 0.25 every unknown cell would be free."""
    text = write_grid(true_grid(), tmp_path / "t.yaml").read_text()
    unknown = (load_as_nav2(tmp_path / "t.yaml")[0] == -1).sum()
    (tmp_path / "t.yaml").write_text(text.replace("free_thresh: 0.196", "free_thresh: 0.25"))
    assert unknown > 300 and (load_as_nav2(tmp_path / "t.yaml")[0] == -1).sum() == 0


def test_the_picture_is_a_binary_pgm_of_256_greys(tmp_path: Path) -> None:
    write_grid(true_grid(), tmp_path / "t.yaml")
    data = (tmp_path / "t.pgm").read_bytes()
    assert data.startswith(b"P5\n40 30\n255\n") and len(data) == 13 + 1200
    assert cv2.imread(str(tmp_path / "t.pgm"), cv2.IMREAD_UNCHANGED).shape == (30, 40)

"""Maps that kiteline writes load in nav2's map_server with every cell as it was meant, and read the same here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

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

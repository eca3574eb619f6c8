"""The figure of a flight's map."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid import build, to_pgm, to_yaml
from kiteline_basestation.runtime.map_formats import map_ply, tum
from kiteline_lab.plots.plot_map import MapFileError, main, read_map_ply


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder with the map of a hall and the path of one agent."""
    rng = np.random.default_rng(2)
    floor = np.column_stack([rng.uniform([0, 0], [8, 5], (900, 2)), rng.normal(0, 0.01, 900)])
    along, side = rng.uniform(0, 1, 900), np.arange(900) % 4
    x, y = np.choose(side, [8 * along, 8 * along, 0, 8]), np.choose(side, [0, 5, 5 * along, 5 * along])
    points = np.concatenate([floor, np.column_stack([x, y, rng.uniform(0.2, 1.8, 900)])])
    path = np.column_stack([np.linspace(1, 7, 30), 2.5 + np.sin(np.linspace(0, 6, 30)), np.ones(30)])
    pairs = np.column_stack([rng.integers(0, 30, 6000), rng.integers(0, 1800, 6000)])
    grid = build(GridConfig(), path, points, pairs)
    base = tmp_path / "base"
    base.mkdir()
    (base / "map.ply").write_bytes(map_ply(points, grid.labels, np.full(1800, 3)))
    (base / "grid.pgm").write_bytes(to_pgm(grid))
    (base / "grid.yaml").write_bytes(to_yaml(grid))
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :3, 3] = path
    (base / "agent0.tum").write_bytes(tum(np.arange(30) * 50_000_000, poses))
    (base / "agent1.tum").write_bytes(b"")  # an agent that never tracked a frame
    return tmp_path


def test_figure_shows_grid_points_and_path_and_repeats(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(out), "--title", "hall"]) == 0
    assert capsys.readouterr().out.strip() == str(out / "map.png")
    first = (out / "map.png").read_bytes()
    image = cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    found = {tuple(int(v) for v in c[::-1]) for c in np.unique(image.reshape(-1, 3), axis=0)}
    for colour in ("#e9e8e4", "#3a3936", "#1f6fb2"):  # unknown, occupied, the first agent
        assert tuple(bytes.fromhex(colour[1:])) in found
    assert main([str(out), "--png", str(out / "again.png"), "--title", "hall"]) == 0
    assert (out / "again.png").read_bytes() == first


def test_ply_is_read_as_it_was_written(out: Path) -> None:
    found = read_map_ply(out / "base" / "map.ply")
    assert found.xyz.shape == (1800, 3)
    assert (found.label[:900] == 2).mean() < 0.05 < 0.8 < (found.label[900:] == 2).mean()


def test_files_that_are_no_map_are_named(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ply = out / "base" / "map.ply"
    for wrong in (b"", b"ply\nformat ascii 1.0\nend_header\n", ply.read_bytes()[:1000]):
        (out / "wrong.ply").write_bytes(wrong)
        with pytest.raises(MapFileError, match=r"wrong\.ply"):
            read_map_ply(out / "wrong.ply")
    ply.unlink()
    assert main([str(out)]) == 2
    assert "map.ply" in capsys.readouterr().err

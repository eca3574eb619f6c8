"""Files of the grid, and views of it for the status page."""

from dataclasses import replace

import numpy as np

from kiteline_basestation.grid.grid_view import GridViews, dense, differences, grid_files
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_core.arrays import U8
from tests.basestation.flat_rooms import ROOM, box, camera, scan_of
from tests.basestation.grid_scans import CONFIG, drawn, flight, kept


def test_a_far_outlier_makes_no_file_coarser_and_a_long_road_does() -> None:
    scans = flight(10)
    grid = drawn(scans)
    before = dense(grid, 0)
    grid.put(99, scans[0][0], camera(1e3, 1e3, 0.0))
    after = dense(grid, 0)
    assert np.array_equal(before[0], after[0]) and np.array_equal(before[1], after[1]) and after[2] == 0.05
    road = ScanGrid(CONFIG)
    for k in range(120):
        road.put(k, scans[0][0], camera(10.0 * k, 10.0 * k, 0.0))
    cells, corner, cell = dense(road, 0)
    assert cell == 0.2 and cells.size <= 1 << 26
    for k in (0, 60, 119):
        c = np.floor((np.array([10.0 * k, 10.0 * k]) - corner) / cell).astype(int)
        low = np.maximum(c - 20, 0)
        assert (cells[low[1] : c[1] + 40, low[0] : c[0] + 40] == 0).any()


def test_views_code_what_changed_and_stay_as_they_were() -> None:
    scans = flight(10)
    grid = drawn(scans)
    views = GridViews(grid)
    first = views.take()
    assert views.take() is first
    assert first.known_m2() > 20.0
    for place in grid.places:
        assert np.array_equal(first.tile(place).cells, grid.cells(place)[0])
    held = dict(first.tiles)
    grid.remove(3)
    grid.put(50, kept(scan_of(ROOM, 0.0, 3.0, 0.0)), camera(30.0, 3.0, 0.0))
    second = views.take()
    assert dict(first.tiles) == held
    changed = differences(first, second)
    assert changed and set(changed) >= {p for p in second.tiles if p not in first.tiles and p.storey == second.storey}
    for place in {*first.tiles, *second.tiles} - set(changed):
        if place.storey == second.storey:
            assert np.array_equal(first.tile(place).cells, second.tile(place).cells)


def test_files_are_what_map_server_reads() -> None:
    grid = drawn(flight(10))
    files = grid_files(grid, "plan")
    cells, corner, _ = dense(grid, 0)
    head, size, most, pixels = files["plan.pgm"].split(b"\n", 3)
    assert (head, most) == (b"P5", b"255") and size == f"{cells.shape[1]} {cells.shape[0]}".encode()
    grey = np.frombuffer(pixels, np.uint8).reshape(cells.shape)[::-1]
    assert np.array_equal(grey == 254, cells == 0) and np.array_equal(grey == 0, cells > 0)
    text = files["plan.yaml"].decode()
    assert "resolution: 0.05\n" in text and f"origin: [{corner[0]:.6f}, {corner[1]:.6f}, 0.000000]" in text
    assert grid_files(ScanGrid(CONFIG))["grid.pgm"] == b"P5\n1 1\n255\n" + bytes([205])


def read_pgm(data: bytes) -> U8:
    head, size, most, grey = data.split(b"\n", 3)
    columns, rows = map(int, size.split())
    assert (head, most) == (b"P5", b"255")
    return np.frombuffer(grey, np.uint8).reshape(rows, columns)[::-1]


def test_files_of_height_bands_and_of_binary_layers_lie_beside_the_grid() -> None:
    """A shelf at head height leaves the lower bands free; a phantom seen once stays in the binary layers alone."""
    config = replace(CONFIG, band_files=True, binary_files=True, storey_overlap_m=0.0)
    plain = scan_of(np.array(box(-6.0, -6.0, 6.0, 6.0)), 0.0, 0.0, 0.0)
    shelf = np.arange(len(plain)) < 30
    high = replace(
        plain, obstacle_m=np.where(shelf, 2.5, plain.obstacle_m), bands=np.where(shelf, 4, plain.bands).astype(np.uint8)
    )
    phantom = np.arange(len(plain)) > 70
    wrong = replace(
        high,
        obstacle_m=np.where(phantom, 2.0, high.obstacle_m),
        bands=np.where(phantom, 7, high.bands).astype(np.uint8),
    )
    grid = ScanGrid(config)
    for k in range(6):
        grid.put(k, kept(wrong if k == 0 else high, config), camera(0.3 * k, 0.0, 0.0))
    files = grid_files(grid)
    names = ("grid", "grid_0.1-0.5", "grid_0.5-1.2", "grid_1.2-2", "grid_binary")
    assert set(files) == {f"{name}.{end}" for name in names for end in ("pgm", "yaml")}
    images = {name: read_pgm(files[f"{name}.pgm"]) for name in names}
    assert len({image.shape for image in images.values()}) == 1
    assert b"image: grid_1.2-2.pgm" in files["grid_1.2-2.yaml"]
    solid = {name: int((image == 0).sum()) for name, image in images.items()}
    assert solid["grid_1.2-2"] > solid["grid_0.1-0.5"] == solid["grid_0.5-1.2"] > 0
    assert (images["grid"] == 0).sum() == (np.minimum.reduce([images[n] for n in names[1:4]]) == 0).sum()
    gone = (images["grid_binary"] == 0) & (images["grid"] == 254)
    assert gone.sum() > 5
    assert set(grid_files(ScanGrid(CONFIG))) == {"grid.pgm", "grid.yaml"}

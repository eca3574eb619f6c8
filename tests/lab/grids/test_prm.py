"""Precision and recall on grids small enough to know the answer."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_lab.evaluation.trajectories import TrajectoryError
from kiteline_lab.grids.evaluate import between_paths, main
from kiteline_lab.grids.files import GridFile, GridFileError, planar, read_grid
from kiteline_lab.grids.prm import GridEvalConfig, draw_nodes, free_cells, score
from kiteline_lab.grids.prm_kernels import roads_free, spaced_places

FEW = GridEvalConfig(draws=5, nodes=40)


def grid(state: np.ndarray, cell_m: float = 0.1, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> GridFile:
    return GridFile(cell_m, origin, state.astype(np.int8))


def hall() -> np.ndarray:
    state = np.full((60, 80), 100)
    state[5:55, 5:75] = 0
    return state


def test_equal_grids_score_hundred() -> None:
    found = score(grid(hall()), grid(hall()), config=FEW)
    assert found.precision == found.recall == 100.0
    assert found.precision_roads == 5 * 40 * 39 // 2  # an empty hall: every pair sees each other
    assert found.free_true_m2 == pytest.approx(35.0)


def test_a_wall_missed_costs_precision_and_a_wall_dreamt_costs_recall() -> None:
    wall = hall()
    wall[:, 40:42] = 100
    missed = score(grid(hall()), grid(wall), config=FEW)
    assert missed.recall == 100.0
    assert 40.0 < missed.precision < 60.0  # half of all pairs lie on two sides of the middle
    dreamt = score(grid(wall), grid(hall()), config=FEW)
    assert dreamt.precision == 100.0
    assert 40.0 < dreamt.recall < 60.0


def test_unknown_is_not_free() -> None:
    half = hall()
    half[:, 40:] = -1
    found = score(grid(half), grid(hall()), config=FEW)
    assert found.precision == 100.0
    assert found.recall < 40.0


def test_grids_without_free_cells_have_no_roads() -> None:
    found = score(grid(np.full((9, 9), -1)), grid(hall()), config=FEW)
    assert math.isnan(found.precision) and found.precision_roads == 0
    assert found.recall == 0.0


def test_places_of_grids_are_honoured() -> None:
    """The same hall in another frame, with another corner, resolution and alignment."""
    state = hall()
    state[20:30, 20:30] = 100
    fine = np.kron(state, np.ones((2, 2)))
    T = planar(3.0, -1.0, 90.0)
    corner = T @ [0.4, 0.7, 1.0]
    moved = grid(fine, 0.05, (float(corner[0]), float(corner[1]), math.pi / 2))
    plain = grid(state, 0.1, (0.4, 0.7, 0.0))
    aligned = score(plain, moved, T, GridEvalConfig(draws=5, nodes=40, opening_cells=0))
    assert aligned.precision > 99.0 and aligned.recall > 97.0
    assert score(plain, moved, None, FEW).precision < 60.0


def test_opening_takes_thin_rays_away_and_a_radius_narrows() -> None:
    state = hall()
    state[20, 75:] = 0  # one ray through the wall
    assert free_cells(grid(state), GridEvalConfig(opening_cells=0)).sum() == 50 * 70 + 5
    assert free_cells(grid(state), GridEvalConfig()).sum() == 50 * 70
    assert free_cells(grid(hall()), GridEvalConfig(robot_radius_m=0.1)).sum() == 48 * 68


def test_nodes_keep_their_distance_and_lie_in_free_cells() -> None:
    free = free_cells(grid(hall()), FEW)
    nodes = draw_nodes(free, FEW, np.random.default_rng(0))
    assert len(nodes) == 40
    assert free[nodes[:, 1].astype(int), nodes[:, 0].astype(int)].all()
    gaps = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)[np.triu_indices(40, 1)]
    assert gaps.min() >= 0.5 * math.sqrt(50 * 70 / 40)


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_places_are_chosen_one_after_the_other(seed: int, room: int) -> None:
    rng = np.random.default_rng(seed)
    places, apart = rng.integers(0, 12, (60, 2)) + 0.5, float(rng.choice([rng.uniform(0.0, 4.0), 2.0]))  # 2: ties
    expected: list[np.ndarray] = []
    for place in places:
        if len(expected) < room and all(np.linalg.norm(place - other) >= apart for other in expected):
            expected.append(place)
    chosen = np.empty((room, 2))
    assert np.array_equal(chosen[: spaced_places(places, apart, chosen)], np.array(expected))


@given(st.integers(0, 2**32 - 1))
def test_roads_as_by_dense_sampling(seed: int) -> None:
    """A road is free when none of many samples along it lies in a cell that is not; grazed corners aside."""
    rng = np.random.default_rng(seed)
    free = rng.random((12, 15)) < 0.9
    nodes = rng.uniform(-0.5, [15.5, 12.5], (8, 2))
    pairs = np.stack(np.triu_indices(8, 1), axis=1).astype(np.int64)
    out = np.zeros(len(pairs), np.bool_)
    roads_free(free, nodes, pairs, out)
    padded = np.pad(free, 2)
    for (a, b), road in zip(pairs, out, strict=True):
        line = nodes[a] + np.linspace(0, 1, 4000)[:, None] * (nodes[b] - nodes[a])
        cells = np.floor(line).astype(int) + 2
        sampled = padded[cells[:, 1], cells[:, 0]]
        if not sampled.all():
            assert not road
        elif not road:  # the line may cut a corner between two samples
            solid = np.argwhere(~padded) - 2 + 0.5
            reach = np.abs(line[:, None, ::-1] - solid[None]).max(axis=2).min()
            assert reach < 0.5 + 0.01


def write(folder: Path, name: str, image: bytes, **fields: str) -> Path:
    (folder / f"{name}.pgm").write_bytes(image)
    lines = {"image": f"{name}.pgm", "resolution": "0.1", "origin": "[1.0, 2.0, 0.0]", "negate": "0"} | fields
    path = folder / f"{name}.yaml"
    path.write_text("".join(f"{k}: {v}\n" for k, v in lines.items()))
    return path


def test_reads_both_kinds_of_pgm(tmp_path: Path) -> None:
    plain = read_grid(write(tmp_path, "a", b"P2\n# made by hand\n3 2\n255\n254 0 205\n0 0 254\n"))
    binary = read_grid(write(tmp_path, "b", b"P5 3 2 255\n" + bytes([254, 0, 205, 0, 0, 254])))
    negated = read_grid(write(tmp_path, "c", b"P5\n3 2\n255\n" + bytes([1, 255, 100, 255, 255, 1]), negate="1"))
    expected = [[100, 100, 0], [0, 100, -1]]  # the first row is the lowest
    for found in (plain, binary, negated):
        assert found.state.tolist() == expected
        assert found.origin == (1.0, 2.0, 0.0) and found.cell_m == 0.1


def test_bad_files_are_named(tmp_path: Path) -> None:
    cut = write(tmp_path, "cut", b"P5\n30 20\n255\nabc")
    with pytest.raises(GridFileError, match=r"cut\.pgm: no complete PGM"):
        read_grid(cut)
    with pytest.raises(GridFileError, match="PGM"):
        read_grid(write(tmp_path, "png", b"\x89PNG\r\n"))
    with pytest.raises(GridFileError, match="expected numbers"):
        read_grid(write(tmp_path, "odd", b"P5\n1 1\n255\n\0", resolution="fine"))
    (tmp_path / "none.yaml").write_text("hello")
    with pytest.raises(GridFileError, match="no image, resolution, origin"):
        read_grid(tmp_path / "none.yaml")
    with pytest.raises(GridFileError, match=r"missing\.yaml"):
        main([str(tmp_path / "missing.yaml"), str(cut)])


def test_command_prints_json_that_repeats(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = np.where(hall() == 0, 254, 0).astype(np.uint8)[::-1].tobytes()
    path = str(write(tmp_path, "hall", b"P5\n80 60\n255\n" + image))
    outputs = []
    for _ in range(2):
        assert main([path, path, "--draws", "3", "--nodes", "20"]) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]
    found = json.loads(outputs[0])
    assert found["precision_percent"] == found["recall_percent"] == 100.0
    assert main([path, path, "--draws", "3", "--nodes", "20", "--transform", "1", "0", "0"]) == 0
    assert json.loads(capsys.readouterr().out)["precision_percent"] < 90.0


def test_the_motion_between_two_paths_is_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz = np.column_stack(
        [np.linspace(0.0, 5.0, 40), 0.01 * rng.standard_normal(40), np.full(40, 1.3)]
    )  # nearly straight
    T = planar(1.0, -2.0, 150.0)
    true = np.column_stack([xyz[:, :2] @ T[:2, :2].T + T[:2, 2], xyz[:, 2] + 4.0])
    for name, places in (("est.tum", xyz), ("true.tum", true)):
        rows = [f"{100 + 0.05 * k:.3f} {x} {y} {z} 0 0 0 1" for k, (x, y, z) in enumerate(places.tolist())]
        (tmp_path / name).write_text("\n".join(rows) + "\n")
    assert between_paths(str(tmp_path / "est.tum"), str(tmp_path / "true.tum")) == pytest.approx(T, abs=1e-6)
    (tmp_path / "later.tum").write_text("900 0 0 0 0 0 0 1\n901 1 0 0 0 0 0 1\n902 1 0 0 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match="true pose"):
        between_paths(str(tmp_path / "later.tum"), str(tmp_path / "true.tum"))


def test_grids_in_two_frames_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = np.full((120, 160), 254, np.uint8)
    image[[0, -1], :] = image[:, [0, -1]] = image[30:50, 90:110] = 0
    (tmp_path / "g.pgm").write_bytes(b"P5\n160 120\n255\n" + image.tobytes())
    for name, origin in (("here", "[0.0, 0.0, 0.0]"), ("there", "[1.0, 2.0, 0.7]")):
        (tmp_path / f"{name}.yaml").write_text(f"image: g.pgm\nresolution: 0.05\norigin: {origin}\n")
    here, there = (str(tmp_path / f"{name}.yaml") for name in ("here", "there"))
    few = ["--draws", "2", "--nodes", "10"]
    main([here, here, *few])
    assert not capsys.readouterr().err
    main([here, there, *few])
    told = capsys.readouterr()
    assert "to lie in two frames; --paths EST GT" in told.err and told.out.startswith("{")
    main([here, there, *few, "--transform", "1", "2", "0.1"])
    assert not capsys.readouterr().err, "the user knows"

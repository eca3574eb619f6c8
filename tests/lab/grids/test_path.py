"""Shortest paths: against Dijkstra, and where there is none."""

import heapq
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_lab.grids.files import FREE, OCCUPIED, UNKNOWN, GridFile
from kiteline_lab.grids.path import GridPathError, clearance_m, find_path, main
from kiteline_lab.grids.path_kernels import search


def grid(state: np.ndarray, cell_m: float = 0.1, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> GridFile:
    return GridFile(cell_m, origin, state.astype(np.int8))


def hall_with_wall() -> np.ndarray:
    """6 by 8 m; a wall from below, and a gap of 0.6 m above it."""
    state = np.full((60, 80), FREE)
    state[:54, 40:42] = OCCUPIED
    return state


def write(folder: Path, state: np.ndarray) -> None:
    image = np.where(state == FREE, 254, 0).astype(np.uint8)[::-1]
    (folder / "g.pgm").write_bytes(b"P5\n80 60\n255\n" + image.tobytes())
    (folder / "g.yaml").write_text("image: g.pgm\nresolution: 0.1\norigin: [-4.0, -3.0, 0.0]\n")


def at(*xy: float) -> np.ndarray:
    return np.array(xy)


def dijkstra(clear: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> float:
    best, queue = {start: 0.0}, [(0.0, start)]
    while queue:
        length, (r, c) = heapq.heappop(queue)
        if (r, c) == goal:
            return length
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                to = r + dr, c + dc
                if to == (r, c) or not (0 <= to[0] < clear.shape[0] and 0 <= to[1] < clear.shape[1]):
                    continue
                if not (clear[to] and clear[r, to[1]] and clear[to[0], c]):
                    continue
                longer = length + math.hypot(dr, dc)
                if longer < best.get(to, math.inf) - 1e-12:
                    best[to] = longer
                    heapq.heappush(queue, (longer, to))
    return math.inf


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_the_search_finds_the_shortest_way(seed: int) -> None:
    rng = np.random.default_rng(seed)
    clear = rng.random((14, 17)) < rng.uniform(0.55, 0.95)
    start, goal = (int(rng.integers(14)), int(rng.integers(17))), (int(rng.integers(14)), int(rng.integers(17)))
    clear[start] = clear[goal] = True
    n = clear.size
    cost, before = np.full(n, np.inf), np.full(n, -1, np.int64)
    found = search(
        clear, start[0] * 17 + start[1], goal[0] * 17 + goal[1], cost, before, np.zeros(n, np.bool_),
        np.empty(8 * n + 8), np.empty(8 * n + 8, np.int64),
    )  # fmt: skip
    expected = dijkstra(clear, start, goal)
    assert found == math.isfinite(expected)
    if found:
        assert cost[goal[0] * 17 + goal[1]] == pytest.approx(expected, abs=1e-9)


def test_the_way_round_a_wall_keeps_the_radius() -> None:
    path = find_path(grid(hall_with_wall()), at(2.0, 2.0), at(6.0, 2.0), 0.15)
    assert path.length_m > 2 * math.hypot(2.0, 3.5) * 0.95
    assert path.length_m < 2 * math.hypot(2.0, 3.9) + 0.6
    assert path.clearance_m >= 0.15 - 1e-9
    assert np.allclose(path.places[0], [2.05, 2.05]) and np.allclose(path.places[-1], [6.05, 2.05])
    along = np.concatenate([np.linspace(a, b, 200) for a, b in zip(path.places, path.places[1:], strict=False)])
    blocked = np.argwhere(hall_with_wall() == OCCUPIED)[:, ::-1] * 0.1
    near = np.clip(along[:, None], blocked[None], blocked[None] + 0.1)  # nearest point of each blocked cell
    assert np.linalg.norm(along[:, None] - near, axis=2).min() > 0.15 - 0.071, "a corner is cut within clear cells"


def test_a_straight_way_is_straight() -> None:
    path = find_path(grid(np.full((60, 80), FREE), 0.1, (1.0, -2.0, 0.0)), at(2.0, -1.0), at(8.0, 2.0), 0.2)
    assert path.length_m == pytest.approx(math.hypot(6.0, 3.0), abs=0.02) and len(path.places) == 2


def test_a_turned_grid_gives_the_same_way() -> None:
    origin = (3.0, -1.0, 0.5 * math.pi)
    plain = find_path(grid(hall_with_wall()), at(2.01, 2.01), at(6.01, 2.01), 0.15)
    there = [np.array([3.0 - y, -1.0 + x]) for x, y in ((2.01, 2.01), (6.01, 2.01))]
    turned = find_path(grid(hall_with_wall(), 0.1, origin), there[0], there[1], 0.15)
    assert turned.length_m == pytest.approx(plain.length_m, abs=1e-9)
    assert np.allclose(turned.places[:, 0], 3.0 - plain.places[:, 1])


def test_clearance_is_a_lower_bound_of_the_distance() -> None:
    rng = np.random.default_rng(3)
    blocked = rng.random((20, 25)) < 0.05
    found = clearance_m(blocked, 0.5)
    cells = np.argwhere(np.pad(blocked, 1, constant_values=True)) - 1.0
    assert not found[blocked].any() and (~blocked).sum() > 400
    for r, c in np.argwhere(~blocked):
        near = np.clip([r + 0.5, c + 0.5], cells, cells + 1.0)
        true = 0.5 * np.linalg.norm(near - [r + 0.5, c + 0.5], axis=1).min()
        assert true - 0.5 * (math.sqrt(0.5) - 0.5) - 1e-6 <= found[r, c] <= true + 1e-6


@pytest.mark.parametrize(
    ("start", "goal", "text"),
    [
        ((4.05, 1.0), (1.0, 1.0), "start 4.05,1 lies in an obstacle"),
        ((1.0, 1.0), (9.0, 1.0), "goal 9,1 lies outside of the grid, 0,0 to 8,6"),
        ((1.0, 1.0), (7.5, 1.0), "goal 7.5,1 lies in an unknown cell; --through-unknown"),
        ((3.9, 1.0), (1.0, 1.0), "start 3.9,1 is 0.0. m from what blocks the way"),
    ],
)
def test_ends_that_cannot_be_are_told(start: tuple[float, float], goal: tuple[float, float], text: str) -> None:
    state = hall_with_wall()
    state[:, 70:] = UNKNOWN
    with pytest.raises(GridPathError, match=text):
        find_path(grid(state), at(*start), at(*goal), 0.15)


def test_the_nearest_place_with_room_is_named(tmp_path: Path) -> None:
    for place in ((4.05, 1.0), (3.9, 1.0), (-2.0, 3.0)):
        with pytest.raises(GridPathError, match="the nearest place with room is") as told:
            find_path(grid(hall_with_wall()), at(*place), at(1.0, 1.0), 0.15)
        named = at(*map(float, str(told.value).rsplit(" ", 1)[1].split(",")))
        assert find_path(grid(hall_with_wall()), named, at(1.0, 1.0), 0.15).length_m > 0.0
        assert np.linalg.norm(named - place) < 2.5
    with pytest.raises(GridPathError, match="nowhere in this grid is room"):
        find_path(grid(hall_with_wall()), at(2.0, 1.0), at(1.0, 1.0), 9.0)
    write(tmp_path, hall_with_wall())
    with pytest.raises(GridPathError):
        main([str(tmp_path / "g.yaml"), "0.05,-1", "2,-1", "--plot", str(tmp_path / "why.png")])
    drawn = cv2.imread(str(tmp_path / "why.png"))
    assert ((drawn[..., 1] > 120) & (drawn[..., 2] < 90)).any(), "the start in green"


def test_no_way_for_a_wide_vehicle_and_none_through_the_unknown_unless_allowed() -> None:
    with pytest.raises(GridPathError, match=r"no path of radius 0\.4 m from 2,2 to 6,2"):
        find_path(grid(hall_with_wall()), at(2.0, 2.0), at(6.0, 2.0), 0.4)
    state = hall_with_wall()
    state[54:, 40:42] = UNKNOWN
    with pytest.raises(GridPathError, match="--through-unknown lets"):
        find_path(grid(state), at(2.0, 2.0), at(6.0, 2.0), 0.15)
    assert find_path(grid(state), at(2.0, 2.0), at(6.0, 2.0), 0.15, through_unknown=True).length_m > 7.0


def test_the_command_prints_metres_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path, hall_with_wall())
    arguments = [str(tmp_path / "g.yaml"), "-2,-1", "2,-1", "--radius", "0.15"]
    assert main([*arguments, "--plot", str(tmp_path / "p.png")]) == 0
    said = capsys.readouterr().out
    drawn = cv2.imread(str(tmp_path / "p.png"))
    assert said.startswith("8.") and " m, " in said
    assert ((drawn[..., 2] > 180) & (drawn[..., 0] < 90)).sum() > 100, "the path is drawn in red"
    assert main([*arguments, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["length_m"] == pytest.approx(float(said.split()[0]), abs=0.01) and found["clearance_m"] >= 0.15
    assert found["corners_m"][0] == [-1.95, -0.95]


@pytest.mark.parametrize("place", ["nan,0", "1e300,0", "0,inf"])
def test_places_that_are_nowhere_are_refused_by_name(place: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["grid.yaml", "0,0", place])
    assert left.value.code == 2
    assert "expected X,Y in m" in capsys.readouterr().err

"""Distances around the vehicle from tiles of the grid, against a room that is known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_agent.exchange.obstacles import REACH_M, SECTORS, obstacle_distances
from kiteline_agent.runtime.controller import push_obstacles
from kiteline_codec.schema import GridTile
from kiteline_core.geometry import se3

CELL_M = 0.1
WEST, EAST, SOUTH, NORTH = -2.0, 3.0, -1.5, 2.0  # walls of a room


def room(known_until_m: float = 20.0) -> dict[tuple[int, int], GridTile]:
    """Tiles in which cells beyond the walls are unknown, and those west of known_until_m too."""
    tiles = {}
    for column in range(-4, 5):
        for row in range(-4, 5):
            x = ((column * 64 + np.arange(64)) + 0.5)[None, :] * CELL_M
            y = ((row * 64 + np.arange(64)) + 0.5)[:, None] * CELL_M
            inside = (x > WEST) & (x < EAST) & (y > SOUTH) & (y < NORTH)
            wall = ~inside & (x > WEST - 0.2) & (x < EAST + 0.2) & (y > SOUTH - 0.2) & (y < NORTH + 0.2)
            cells = np.where(wall, 7, np.where(inside, 0, -1))
            tiles[column, row] = GridTile(
                column, row, 0, CELL_M, np.where(x > -known_until_m, cells, -1).astype(np.int8)
            )
    return tiles


def vehicle(x: float, y: float, heading_rad: float, tilt_rad: float = 0.0) -> np.ndarray:
    """T_w_f: heading counter-clockwise from x of w."""
    upright = se3.so3_exp(np.array([0.0, 0.0, heading_rad])) @ np.diag([1.0, -1.0, -1.0])
    return se3.from_rt(upright @ se3.so3_exp(np.array([tilt_rad, 0.0, 0.0])), np.array([x, y, 1.0]))


@given(
    x=st.floats(-1.5, 2.5), y=st.floats(-1.0, 1.5), quarter=st.integers(0, 3), tilt=st.floats(-0.4, 0.4),
)  # fmt: skip
def test_walls_of_a_room_lie_ahead_right_behind_and_left(x: float, y: float, quarter: int, tilt: float) -> None:
    distances = obstacle_distances(room(), vehicle(x, y, quarter * np.pi / 2, tilt))
    assert distances is not None and distances.shape == (SECTORS,)
    walls = [EAST - x, y - SOUTH, x - WEST, NORTH - y]  # clockwise from x of w
    for k in range(4):
        assert distances[k * SECTORS // 4] == pytest.approx(walls[(k - quarter) % 4], abs=1.5 * CELL_M)
    assert np.isfinite(distances).all()


def test_what_is_not_known_is_not_free() -> None:
    distances = obstacle_distances(room(known_until_m=1.0), vehicle(0.0, 0.0, 0.0))
    assert distances is not None
    assert np.isnan(distances[SECTORS // 2]) and distances[0] == pytest.approx(EAST, abs=0.15)
    free = {(c, r): GridTile(c, r, 0, CELL_M, np.zeros((64, 64), np.int8)) for c in range(-5, 5) for r in range(-5, 5)}
    far = obstacle_distances(free, vehicle(0.0, 0.0, 0.7))
    assert far is not None and np.isinf(far).all()
    free[0, 0].cells[5, 20] = 4  # one cell, 2.1 m away
    near = obstacle_distances(free, vehicle(0.0, 0.0, np.arctan2(5.5, 20.5)))
    assert near is not None and near[0] == pytest.approx(2.12, abs=0.1) and near.min() <= near[0] < REACH_M


def test_without_a_grid_or_a_heading_nothing_is_told() -> None:
    assert obstacle_distances({}, vehicle(0.0, 0.0, 0.0)) is None
    nose_up = vehicle(0.0, 0.0, 0.0) @ se3.from_rt(se3.so3_exp(np.array([0.0, np.pi / 2, 0.0])), np.zeros(3))
    assert obstacle_distances(room(), nose_up) is None


@pytest.mark.parametrize("cell_m", [1e-30, 1e-4, 25.0, 1e30])
def test_any_size_of_cells_costs_little(cell_m: float) -> None:
    """A tile is a record from the link."""
    tiles = {(0, 0): GridTile(0, 0, 0, cell_m, np.full((64, 64), 3, np.int8))}
    with np.errstate(invalid="ignore", over="ignore"):
        distances = obstacle_distances(tiles, vehicle(0.5, 0.5, 0.0))
    assert distances is not None and distances.shape == (SECTORS,)
    if cell_m > REACH_M:
        assert distances[SECTORS // 4] == 0.5 or np.isnan(distances).any()  # the cell around the vehicle


class Heard:
    """Stands for the flight controller's link."""

    T_b_f = np.eye(4)

    def __init__(self) -> None:
        self.sent: list[list[float]] = []

    def push_obstacles(self, distance_m: list[float], reach_m: float, now_ns: int) -> None:
        self.sent.append(distance_m)


def test_only_a_vehicle_that_is_tracked_in_the_world_tells_its_obstacles() -> None:
    agent, heard = SimpleNamespace(tiles=room()), Heard()

    def push(*, tracked: bool, placed: bool) -> int:
        estimate = SimpleNamespace(tracked=tracked, T_w_b=vehicle(0.0, 0.0, 0.0) if placed else None)
        push_obstacles(cast(Any, heard), cast(Any, agent), cast(Any, SimpleNamespace(estimate=estimate)), 5)
        return len(heard.sent)

    assert push(tracked=False, placed=True) == 0
    assert push(tracked=True, placed=False) == 0
    assert push(tracked=True, placed=True) == 1
    assert heard.sent[0][0] == pytest.approx(EAST, abs=0.15)

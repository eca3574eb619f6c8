"""What counts as an obstacle to a vehicle of another height or width."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.config import LocalGridConfig
from kiteline_agent.scans.local_grid import SECTORS, LocalGrid
from tests.agent.scans.test_local_grid import BANDS_M, EXACT, TURN, room, scan_at, vehicle


@pytest.mark.parametrize(("body_m", "told"), [(0.25, False), (1.5, True)])
def test_a_taller_vehicle_has_obstacles_farther_above_and_below(body_m: float, told: bool) -> None:
    grid = LocalGrid(LocalGridConfig(body_m=body_m))
    grid.add(scan_at(0.0, 0.0, 0.0, z=1.0), EXACT)  # which tells the height above ground
    low, T_w_f = room(mask=1), vehicle(0.0, 0.0, 0.0, z=1.5)  # walls that reach 0.5 m above the ground
    found = grid.around(TURN @ T_w_f, T_w_f, low, BANDS_M)
    assert bool(np.isfinite(found.distance_m[SECTORS // 2])) == told


def test_cells_within_a_wider_vehicle_are_none_of_its_obstacles() -> None:
    tiles = room()
    for at in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        cells = tiles[at].cells.copy()
        cells[np.ix_(*[np.r_[0:3] if k >= 0 else np.r_[61:64] for k in (at[1], at[0])])] = 7  # 0.3 m about the middle
        tiles[at] = replace(tiles[at], cells=cells)
    T_w_f = vehicle(0.0, 0.0, 0.0)
    found = [
        LocalGrid(LocalGridConfig(vehicle_m=vehicle_m)).around(T_w_f, T_w_f, tiles, BANDS_M).distance_m[0]
        for vehicle_m in (0.15, 0.6)
    ]
    assert found[0] < 0.3 and found[1] > 2.0

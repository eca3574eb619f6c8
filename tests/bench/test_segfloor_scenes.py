"""Worlds like Segfloor's: as large as the thesis says, and driven without touching anything."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from kiteline_bench.papers.segfloor.scenes import Scene, corridor_1, corridor_2, synthetic, trajectory
from kiteline_hw.sim.truth.occupancy import FREE, occupancy


@pytest.mark.parametrize(
    ("make", "area_m2", "way_m"), [(corridor_1, 10.0, 12.5), (corridor_2, 7.9, 8.3), (synthetic, 682.7, 138.4)]
)  # fmt: skip
def test_areas_and_ways_are_those_of_the_thesis(
    make: Callable[[int], Scene], area_m2: float, way_m: float
) -> None:  # fmt: skip
    scene = make(4)
    true = occupancy(scene.world, 0.1, 2.0, 0.02 if area_m2 < 100.0 else 0.05)
    _, poses = trajectory(scene)
    free = true.image == FREE
    assert free.sum() * true.cell_m**2 == pytest.approx(area_m2, rel=0.02)
    _, pieces = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    assert pieces.max() == 1
    clear_m = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, 5) * true.cell_m
    cells = np.floor((poses[:, :2, 3] - true.corner) / true.cell_m).astype(int)
    assert clear_m[cells[:, 1], cells[:, 0]].min() > 0.15
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() == pytest.approx(way_m, rel=0.03)
    assert np.allclose(poses[:, 2, 3], scene.camera_m)
    assert np.allclose(-poses[:, 2, 2], np.sin(scene.tilt_rad))  # it looks down by the tilt

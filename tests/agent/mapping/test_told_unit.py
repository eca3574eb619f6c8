"""Two views of one camera begin a map after a loss: a sensor that told the way between them tells its unit roughly."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.initialisation.two_view_start import TwoViewMap
from kiteline_agent.keyframes.new_landmarks import NewPoints
from kiteline_agent.mapping.told_unit import ToldUnit, told_unit
from kiteline_core.geometry import se3

FIRST = se3.exp(np.array([3.0, -1.0, 0.5, 0.1, 0.4, -0.2]))
STEP = se3.exp(np.array([0.3, 0.05, -0.1, 0.0, 0.05, 0.02]))  # T_a_b by images, in another unit than metres


def views(images: Any = None) -> TwoViewMap:
    points = NewPoints(np.zeros((3, 2)), np.array([10.0, 20.0, 5.0]), np.zeros(3, np.uint8), np.zeros(3), np.zeros(3))  # type: ignore[arg-type]
    return TwoViewMap(images, 0, FIRST, 3, STEP, points, 4.0)


def camera(*, measures: bool = True, metres: bool = True, any_map: bool = True, sigma_m_s: float = 0.0) -> Any:
    motion, submaps = SimpleNamespace(told=measures, velocity_sigma=sigma_m_s), SimpleNamespace(any=any_map)
    return SimpleNamespace(motion=motion, submaps=submaps, had_metres=metres)


def unit(of: Any, way_m: float = 0.5) -> ToldUnit | None:
    told = FIRST @ se3.from_rt(np.eye(3), np.array([0.0, 0.0, way_m]))
    ctx: Any = SimpleNamespace(T_m_c=told, t_ns=400_000_000)
    return told_unit(of, ctx, views())


def test_the_unit_is_the_way_that_was_told_over_that_of_the_images() -> None:
    found = unit(camera())
    assert found is not None and found.metres == pytest.approx(0.5 / np.linalg.norm(STEP[:3, 3]))
    assert unit(camera(), way_m=0.01) is None  # too short to tell


def test_lengths_are_as_uncertain_as_the_way_and_a_young_map() -> None:
    sure, unsure, short = unit(camera()), unit(camera(sigma_m_s=0.2)), unit(camera(sigma_m_s=0.2), way_m=0.2)
    assert sure is not None and unsure is not None and short is not None
    assert 0.05 < sure.sigma < 0.15
    assert unsure.sigma**2 - sure.sigma**2 == pytest.approx((0.2 * 0.4 / 0.5) ** 2)
    assert short.sigma > 0.4


@pytest.mark.parametrize("lacking", ["measures", "metres", "any_map"])
def test_where_nothing_tells_metres_the_unit_is_a_convention(lacking: str) -> None:
    assert unit(camera(**{lacking: False})) is None


def test_all_lengths_of_a_map_grow_together() -> None:
    grown = views().scaled(2.5)
    np.testing.assert_allclose(grown.T_a_b[:3, 3], 2.5 * STEP[:3, 3])
    np.testing.assert_array_equal(grown.T_a_b[:3, :3], STEP[:3, :3])
    np.testing.assert_allclose(grown.points.disparity, views().points.disparity / 2.5)  # depths are 2.5 times as large
    assert grown.median_depth_m == pytest.approx(10.0)

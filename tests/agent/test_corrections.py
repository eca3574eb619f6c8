"""What the agent knows of how its submaps lie to each other, by what a base says."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_codec.schema import Key, SubmapPlacement
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import AgentId, submap_id

FIRST, YOUNG = submap_id(AgentId(0), 1, 0), submap_id(AgentId(0), 1, 1)
UPRIGHT = se3.exp(np.array([0.0, 0.0, 0.0, 0.1, -0.05, 0.0]))
ODOMETRY = se3.exp(np.array([0.4, 0.1, -0.2, 0.0, 0.0, 0.05]))  # T_first_young as the agent has it
CARRIED = ODOMETRY @ se3.exp(np.array([0.06, 0.0, 0.0, 0.0, 0.0, 0.01]))  # as a base has it, a frame's motion later
FOUND = se3.exp(np.array([1.3, -0.6, 0.1, 0.0, 0.0, 0.4]))


@pytest.fixture
def base() -> Corrections:
    camera, config = RectifiedCamera(752, 480, 450.0, 450.0, 370.0, 240.0, 0.11, True, np.eye(4)), AgentConfig()
    local_map = LocalMap(camera, config.local_map, config.depth_filter)
    window = MapCache(camera, config.window, config.matching, config.ransac, None)
    known = Corrections(local_map, window, config.smoothing)
    known.begins(YOUNG, ODOMETRY)
    return known


def say(base: Corrections, T_w_first: NDArray[np.float64], T_first_young: NDArray[np.float64] | None) -> bool:
    """A base says where submaps lie; whether the young one counts as placed."""
    records = [SubmapPlacement(FIRST, T_w_first)]
    if T_first_young is not None:
        records = [SubmapPlacement(YOUNG, T_w_first @ T_first_young), *records]
    base.take(records, [])
    return base.has_placed(YOUNG)


def test_a_base_that_takes_the_odometrys_word_has_placed_nothing(base: Corrections) -> None:
    assert not base.has_placed(YOUNG)
    assert not say(base, np.eye(4), None)
    assert not say(base, np.eye(4), CARRIED)
    assert not say(base, UPRIGHT, CARRIED)  # the world is set upright
    assert say(base, UPRIGHT, FOUND)
    assert not say(base, UPRIGHT, CARRIED)  # a merge is undone


def test_a_submap_that_had_no_place_is_placed_where_it_is_recognised(base: Corrections) -> None:
    assert not say(base, np.eye(4), None)
    assert say(base, np.eye(4), FOUND)
    base.take([], [Key(SubmapPlacement.KIND, int(YOUNG), 0)])
    assert not base.has_placed(YOUNG)

"""Where the base says that a submap lies, and how long: the live pose in w takes it on, the odometry does not."""

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig, SmoothingConfig
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_codec.schema import Key, SubmapPlacement
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import submap_id

T_B_C = se3.exp(np.array([0.1, -0.05, 0.02, 0.3, 0.1, -1.2]))
CAMERA = RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.1, False, T_B_C)
SUBMAP = submap_id(3, 1, 0)


@pytest.mark.parametrize("pace", [0.0, 0.5])
def test_a_place_with_a_scale_stretches_the_way_but_not_the_arm(pace: float) -> None:
    config = AgentConfig()
    window = MapCache(CAMERA, config.map_cache, config.matching, config.ransac, None)
    local_map = LocalMap(CAMERA, config.local_map)
    base = Corrections(local_map, window, SmoothingConfig(max_m_s=pace, max_rad_s=pace, snap_m=0.3))
    T_m_c = se3.exp(np.array([2.0, 1.0, 0.3, 0.1, 0.4, -0.2]))
    T_m_b, T_o_m = T_m_c @ se3.inverse(T_B_C), se3.exp(np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.7]))
    assert base.in_world(SUBMAP, T_m_b, T_o_m, 0, metric=False) is None
    S_w_m = sim3.of(2.7, se3.exp(np.array([1.0, -4.0, 0.2, 0.02, 0.0, 1.3])))
    assert not base.take([SubmapPlacement(SUBMAP, S_w_m)], [])[0]  # the local map, and with it odometry, stays
    told = base.in_world(SUBMAP, T_m_b, T_o_m, 50_000_000, metric=False)
    assert np.allclose(told, sim3.place(S_w_m, T_m_c) @ se3.inverse(T_B_C), atol=1e-9)
    eye, body = (told @ T_B_C)[:3, 3], told[:3, 3]
    assert np.isclose(np.linalg.norm(eye - body), np.linalg.norm(T_B_C[:3, 3]))
    base.take([], [Key(SubmapPlacement.KIND, int(SUBMAP), 0)])
    assert base.in_world(SUBMAP, T_m_b, T_o_m, 100_000_000, metric=False) is None

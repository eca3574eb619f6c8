"""What the base finds of a pair's disparities: depths that the pair measured follow, what is shared stays raw."""

import numpy as np

from kiteline_agent.config import LocalMapConfig
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_codec.schema import KeyframeHeader, RefinedLandmarks
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, submap_id
from tests.agent.plain_landmarks import plain_landmarks

CAMERA = RectifiedCamera(752, 480, 450.0, 450.0, 376.0, 240.0, 0.1, True, np.eye(4))
CONSTANT = np.array([0.1, 0.0, 0.0, 0.0, 0.0])
FIRST = keyframe_id(submap_id(AgentId(0), 0, 0), 0)


def held_map(disparity: list[float]) -> LocalMap:
    held = LocalMap(CAMERA, LocalMapConfig())
    n = len(disparity)
    landmarks = plain_landmarks(np.full((n, 2), 200.0), np.array(disparity) / CAMERA.bf)
    held.add(KeyframeHeader(FIRST, 0, NO_KEYFRAME, np.eye(4), n), np.eye(4), landmarks, 0)
    held.share(FIRST, n)
    return held


def test_measured_depths_follow_and_others_stay() -> None:
    held = held_map([10.0, 8.0, 0.0])  # the last is a bearing
    one = np.array([1], np.uint16)
    held.refine(RefinedLandmarks(FIRST, one, np.array([0.2], np.float32), np.zeros((1, 2), np.float32)))
    assert held.apply_corrections()
    bearing = float(held.rho[0, 2])
    held.set_disparity_offset(CONSTANT)
    assert np.allclose(held.rho[0, :3], [9.9 / CAMERA.bf, 0.2, bearing], atol=1e-7)
    held.set_disparity_offset(-0.5 * CONSTANT)  # an offset takes the place of the one before, it does not add to it
    assert np.isclose(held.rho[0, 0], 10.05 / CAMERA.bf)
    held.set_disparity_offset(0.0 * CONSTANT)
    assert np.isclose(held.rho[0, 0], 10.0 / CAMERA.bf)


def test_an_offset_differs_over_the_image() -> None:
    held = held_map([10.0])
    rolled = np.array([0.02, 0.0, 0.35, 0.0, 0.0])
    held.set_disparity_offset(rolled)
    y = (200.0 - CAMERA.cy) / CAMERA.fy
    assert np.isclose(held.rho[0, 0], (10.0 - 0.02 - 0.35 * y) / CAMERA.bf)
    assert np.allclose(held.offset_px(np.array([[0.0, CAMERA.cy], [9.0, CAMERA.cy + 45.0]])), [0.02, 0.055])


def test_far_points_stay_in_front() -> None:
    held = held_map([0.02])
    held.set_disparity_offset(3.0 * CONSTANT)
    assert held.rho[0, 0] > 0.0

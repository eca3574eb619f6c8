"""A map in a unit of its own goes on in metres: live poses are at once where the base will place them."""

import numpy as np
import pytest

from kiteline_agent.tracking.pose_state import PoseState
from kiteline_codec.schema import SubmapPlacement
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from tests.agent.exchange.test_corrections import FIRST, SECOND, made

UNIT_M = 0.4


def flown(pose: PoseState) -> None:
    """A map that lies askew in the odometry frame, and the camera far from its origin."""
    pose.T_m_c = se3.exp(np.array([3.0, -2.0, 1.0, 0.2, 0.4, -0.1]))
    pose.T_o_m = se3.exp(np.array([0.1, 0.2, -0.1, 0.0, 0.05, 0.3]))
    pose.set_motion(se3.exp(np.array([0.1, 0.0, 0.05, 0.0, 0.02, 0.0])), np.array([2.0, 1.0, 0.0]))


def test_a_map_in_metres_has_the_axes_of_the_one_that_it_continues() -> None:
    pose = PoseState()
    flown(pose)
    T_m_c, T_o_c = pose.T_m_c.copy(), pose.T_o_m @ pose.T_m_c
    ahead = pose.predict(0.05)
    pose.rescale_map(UNIT_M)
    np.testing.assert_allclose(pose.T_m_c, sim3.with_scaled_translation(T_m_c, UNIT_M), atol=1e-12)
    np.testing.assert_allclose(pose.T_o_m @ pose.T_m_c, T_o_c, atol=1e-12)  # odometry does not jump
    np.testing.assert_allclose(pose.predict(0.05), sim3.with_scaled_translation(ahead, UNIT_M), atol=1e-9)
    np.testing.assert_allclose(pose.velocity, UNIT_M * np.array([2.0, 1.0, 0.0]))


@pytest.mark.parametrize("scale", [1.0, 1.003])  # the base has made the unit longer meanwhile
def test_live_poses_do_not_move_when_the_base_places_that_map(scale: float) -> None:
    corrections, pose = made(None), PoseState()
    flown(pose)
    S_w_old = sim3.of(scale, se3.exp(np.array([0.5, -0.3, 0.1, 0.0, 0.0, 0.8])))
    corrections.take([SubmapPlacement(FIRST, S_w_old)], [])

    def live(submap: int, t_s: float, *, metric: bool) -> F64:
        found = corrections.in_world(submap, pose.T_m_c, pose.T_o_m, round(1e9 * t_s), metric=metric)  # type: ignore[arg-type]
        assert found is not None
        return found

    before = live(FIRST, 1.0, metric=False)
    old_T_m_c = pose.T_m_c.copy()
    pose.rescale_map(UNIT_M)
    corrections.continue_in_metres(SECOND, FIRST, UNIT_M)
    at_once = live(SECOND, 1.05, metric=True)
    np.testing.assert_allclose(at_once[:3, :3], before[:3, :3], atol=1e-9)
    # the base scales w by its first submap, and places the new one where the old one has the camera
    S_new_old = sim3.of(UNIT_M / scale, np.eye(4)) @ S_w_old
    S_w_new = sim3.normalise(sim3.of(1.0, sim3.place(S_new_old, old_T_m_c)) @ se3.inverse(pose.T_m_c))
    corrections.take([SubmapPlacement(FIRST, S_new_old), SubmapPlacement(SECOND, S_w_new)], [])
    np.testing.assert_allclose(live(SECOND, 1.1, metric=True), at_once, atol=1e-9)


def test_without_a_base_they_are_in_the_map() -> None:
    corrections, pose = made(None), PoseState()
    flown(pose)
    pose.rescale_map(UNIT_M)
    corrections.continue_in_metres(SECOND, FIRST, UNIT_M)
    assert corrections.in_world(SECOND, pose.T_m_c, pose.T_o_m, 10**9, metric=True) is None

"""How far the unknown share of a monocular map's lengths moves its positions."""

import numpy as np
import pytest

from kiteline_agent.config import CovarianceConfig
from kiteline_agent.covariance.pose_covariance import PoseCovariance
from kiteline_agent.covariance.pose_quality import FLAGGED_BELOW, LOST_BELOW
from kiteline_agent.covariance.scale_error import ScaleError
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_core.geometry import se3
from kiteline_core.ids import SubmapId
from tests.agent.seen_scenes import SHAPES, map_of, scene, seen_with

TURN = se3.so3_exp(np.array([0.0, 0.0, 0.7]))
SUBMAP = SubmapId(0)


def monocular() -> PoseCovariance:
    """In a map that began at the origin."""
    local_map = map_of(seen_with(np.zeros(SHAPES), scene(), np.eye(4)), None)
    covariance = PoseCovariance(local_map, np.eye(4), CovarianceConfig(), has_body=False, has_depth=False)
    covariance.begin_submap(np.eye(4), np.eye(4))
    return covariance


def at(*p_m: float) -> np.ndarray:
    return se3.from_rt(np.eye(3), np.array(p_m))


def test_positions_err_along_the_line_to_where_the_map_began() -> None:
    covariance = monocular()
    covariance.set_scale_sigma(0.02)
    cov_m, cov_o = covariance.of_poses(PoseState(), at(3.0, -4.0, 0.0))
    np.testing.assert_allclose(np.sqrt(np.diag(cov_m)), [0.06, 0.08, 0.0, 0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(cov_m, cov_o)
    across = np.array([4.0, 3.0, 0.0]) / 5.0
    assert across @ cov_m[:3, :3] @ across < 1e-9


def test_maps_that_follow_each_other_add_their_errors_up() -> None:
    error = ScaleError()
    error.sigma = 0.02
    error.begin_map(np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(error.in_o(np.array([10.0, 0.0, 0.0])), [0.2, 0.0, 0.0])
    error.begin_map(np.ones(3), np.array([10.0, 0.0, 0.0]))
    error.sigma = 0.01
    np.testing.assert_allclose(error.in_o(np.array([10.0, 5.0, 0.0])), [0.2, 0.05, 0.0])
    np.testing.assert_allclose(error.in_m(np.array([1.0, 6.0, 1.0])), [0.0, 0.05, 0.0])


def test_a_map_that_turns_keeps_the_error_in_the_odometry_frame() -> None:
    covariance, pose = monocular(), PoseState()
    covariance.set_scale_sigma(0.02)
    pose.T_m_c = at(10.0, 0.0, 0.0)
    before = covariance.of_poses(pose, pose.T_m_c)[1]
    covariance.before_map_change(pose, np.eye(4), SUBMAP)
    pose.move_map(se3.from_rt(TURN, np.zeros(3)) @ pose.T_m_c)
    np.testing.assert_allclose(covariance.of_poses(pose, pose.T_m_c)[1], before, atol=1e-9)


def test_a_new_map_begins_certain_and_the_flight_stays_as_it_was() -> None:
    covariance, pose = monocular(), PoseState()
    covariance.set_scale_sigma(0.02)
    pose.T_m_c = at(10.0, 0.0, 0.0)
    covariance.before_map_change(pose, np.eye(4), SUBMAP)
    pose.enter_submap()
    covariance.begin_submap(pose.T_m_c, np.eye(4))
    cov_m, cov_o = covariance.of_poses(pose, pose.T_m_c)
    assert np.sqrt(cov_o[0, 0]) == pytest.approx(0.2, rel=0.01)
    assert np.sqrt(cov_m[0, 0]) < 1e-3


def test_far_from_the_start_poses_are_flagged_and_dead_reckoning_goes_on() -> None:
    covariance = monocular()
    covariance.set_scale_sigma(0.02)
    near, far = (covariance.of_poses(PoseState(), at(x, 0.0, 0.0))[0] for x in (3.0, 20.0))
    assert covariance.quality(near, None) > 95
    assert covariance.quality(far, None) < FLAGGED_BELOW
    covariance.dead_reckon(0.1, 0.02**2 * np.eye(6))
    assert covariance.dead_reckoning_quality() > 95
    covariance.dead_reckon(0.1, 0.5**2 * np.eye(6))
    assert covariance.dead_reckoning_quality() < LOST_BELOW

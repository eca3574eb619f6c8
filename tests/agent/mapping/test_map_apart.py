"""After maps in units of their own, to which nothing ties it, a map in metres begins as a flight does."""

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.step import Identity
from kiteline_codec.schema import SubmapPlacement
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Rectifier
from kiteline_core.ids import AgentId
from tests.agent.exchange.test_corrections import FAR, FIRST, SECOND, made

LENS = CameraModel(752, 480, 450.0, 450.0, 370.0, 240.0)
T_B_C = se3.exp(np.array([0.1, 0.02, -0.05, 0.1, -0.2, 0.3]))
GRAVITY_B = 9.81 * np.array([0.3, -0.5, -np.sqrt(1.0 - 0.09 - 0.25)])
GUESSED = se3.exp(np.array([7.0, -3.0, 2.0, 0.4, 1.0, -2.0]))  # T_o_c after seconds that nothing told


def test_it_is_upright_where_it_begins_and_the_odometry_goes_on() -> None:
    rig = CameraRig(LENS, None, T_B_C, None)
    local_map = LocalMap(Rectifier(rig).camera, AgentConfig().local_map)
    camera = CameraState(rig, ImuCalibration(), AgentConfig(), Identity(AgentId(0), 0), local_map)
    camera.open_submap()
    camera.pose.guess(GUESSED, 4.0)
    camera.begin_upright(GRAVITY_B)
    camera.begin_metres()
    camera.open_submap()
    np.testing.assert_allclose(camera.T_m_b[:3, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(camera.T_m_b[:3, :3] @ GRAVITY_B, [0.0, 0.0, -9.81], atol=1e-9)
    np.testing.assert_allclose(camera.pose.T_o_m @ camera.pose.T_m_c, GUESSED, atol=1e-9)
    _, cov_o = camera.covariance.of_poses(camera.pose, camera.T_m_b)
    np.testing.assert_allclose(cov_o, 0.0, atol=1e-12)  # of poses in metres, which begin here


def test_live_poses_are_in_no_world_until_the_base_has_placed_it() -> None:
    corrections = made(None)
    corrections.take([SubmapPlacement(FIRST, np.eye(4))], [])
    assert corrections.in_world(FIRST, FAR, np.eye(4), 0, metric=False) is not None
    corrections.leave_world()
    assert corrections.in_world(SECOND, np.eye(4), FAR, 50_000_000, metric=True) is None
    corrections.take([SubmapPlacement(SECOND, np.eye(4))], [])
    placed = corrections.in_world(SECOND, FAR, FAR, 100_000_000, metric=True)
    assert placed is not None and np.allclose(placed, FAR)

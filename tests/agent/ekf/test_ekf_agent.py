"""The agent with the filter as its tracker: odometry, black images, gaps, and the same output for the same input."""

import cv2
import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.ekf.corner_flow import CornerFlow
from kiteline_agent.ekf.ekf_agent import EkfAgent
from kiteline_agent.ekf.odometer_motion import OdometerMotion
from kiteline_agent.ekf_config import EkfConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.imaging.features import DetectorConfig, build_pyramid
from kiteline_agent.onboard import onboard_agent
from kiteline_agent.runtime.controller import pose_sample
from kiteline_agent.runtime.options import agent_config
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_core.arrays import U8
from kiteline_core.frame import UNMEASURED, Frame, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, RectifiedCamera
from kiteline_core.ids import AgentId

_PERIOD_NS = 50_000_000
_DEPTH_M, _SPEED_M_S, _FOCAL_PX = 4.0, 0.8, 200.0
_LEFT = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def _odometry(k: int, scale: float = 1.0) -> OdometryBatch:
    """Five samples of a vehicle that moves to its right (-y), up to frame k."""
    t_ns = k * _PERIOD_NS - np.arange(4, -1, -1) * 10_000_000
    velocity = np.tile([0.0, -_SPEED_M_S * scale, 0.0], (5, 1))
    small = np.tile(1e-4 * np.eye(3), (5, 1, 1))
    return OdometryBatch(t_ns, velocity, np.zeros((5, 3)), small, small)


def _flown(frames: int, black_from: int, scale: float = 1.0) -> list[Estimate]:
    """Flies to the right along a textured wall, which is black from a frame on."""
    rng = np.random.default_rng(0)
    wall = np.kron(rng.integers(0, 256, (60, 300)), np.ones((4, 4))).astype(np.uint8)
    camera = CameraModel(320, 240, _FOCAL_PX, _FOCAL_PX, 159.5, 119.5)
    config = AgentConfig(tracker="ekf")
    agent = onboard_agent(
        CameraRig(camera, None, _LEFT, None), None, config, Identity(AgentId(0), 0), NoBaseChannel(), None
    )  # fmt: skip
    assert isinstance(agent, EkfAgent)
    step_px = _SPEED_M_S * 0.05 * _FOCAL_PX / _DEPTH_M  # a whole number: nothing is interpolated
    found = []
    for k in range(frames):
        at = round(k * step_px)
        image = np.ascontiguousarray(wall[:, at : at + 320]) if k < black_from else np.zeros((240, 320), np.uint8)
        output = agent.step(
            StepInput(Frame(k * _PERIOD_NS, image), odometry=_odometry(k, scale) if k else None), k * _PERIOD_NS
        )  # fmt: skip
        assert output.estimate is not None
        found.append(output.estimate)
    return found


def test_flight_along_a_wall_tracks_landmarks_and_goes_on_in_the_dark() -> None:
    found = _flown(60, black_from=50)
    assert found[45].inliers >= 15
    assert not found[45].bridged
    assert found[-1].tracked
    assert found[-1].bridged
    np.testing.assert_allclose(found[-1].T_o_b[:3, 3], [0.0, -59 * 0.05 * _SPEED_M_S, 0.0], atol=0.1)
    assert np.trace(found[-1].cov_o) > np.trace(found[49].cov_o)


def test_motion_is_that_of_the_samples_and_uncertain_in_a_gap() -> None:
    T_b_c = se3.from_rt(_LEFT[:3, :3], np.array([0.3, 0.1, 0.2]))
    motion = OdometerMotion(T_b_c, EkfConfig(), keep_s=3.0, max_gap_s=0.25)
    motion.add(_odometry(0))
    motion.add(_odometry(1))
    known = motion.between(0, _PERIOD_NS)
    assert motion.measured
    np.testing.assert_allclose(known.T_c0_c1[:3, 3], [0.05 * _SPEED_M_S, 0.0, 0.0], atol=1e-6)
    unknown = motion.between(20 * _PERIOD_NS, 21 * _PERIOD_NS)
    assert not motion.measured
    np.testing.assert_allclose(unknown.T_c0_c1, known.T_c0_c1, atol=1e-12)
    assert np.trace(unknown.cov) > 10.0 * np.trace(known.cov)


def test_axes_without_a_measurement_hardly_move() -> None:
    batch = _odometry(1)
    cov = np.tile(np.diag([UNMEASURED, 1e-4, UNMEASURED]), (5, 1, 1))
    motion = OdometerMotion(np.eye(4), EkfConfig(), keep_s=3.0, max_gap_s=0.25)
    motion.add(OdometryBatch(batch.t_ns, batch.velocity + [5.0, 0.0, 5.0], batch.rate, cov, batch.rate_cov))
    moved = motion.between(0, _PERIOD_NS)
    np.testing.assert_allclose(moved.T_c0_c1[:3, 3], [0.0, -0.05 * _SPEED_M_S, 0.0], atol=1e-3)
    assert (np.linalg.eigvalsh(moved.cov) < 0.01).all()


@pytest.mark.parametrize("has_body", [True, False])
def test_poses_go_to_the_flight_controller_gravity_aligned(has_body: bool) -> None:
    """None went: the odometry frame was never known to be level."""
    camera, config = CameraModel(320, 240, _FOCAL_PX, _FOCAL_PX, 159.5, 119.5), AgentConfig(tracker="ekf")
    rig = CameraRig(camera, None, _LEFT if has_body else np.eye(4), None, has_body=has_body)
    agent = EkfAgent(rig, config, Identity(AgentId(0), 0), NoBaseChannel())
    black, ahead = np.zeros((240, 320), np.uint8), 0 if has_body else 2
    small = np.tile(1e-4 * np.eye(3), (5, 1, 1))
    for k in range(3):
        t_ns = k * _PERIOD_NS - np.arange(4, -1, -1) * 10_000_000
        velocity = np.tile(np.eye(3)[ahead], (5, 1))
        batch = OdometryBatch(t_ns, velocity, np.zeros((5, 3)), small, small)
        output = agent.step(StepInput(Frame(k * _PERIOD_NS, black), odometry=batch), k * _PERIOD_NS)
    sample = pose_sample(agent, output, 0, 0)
    np.testing.assert_allclose(sample.T_o_b[:3, 3], [0.1, 0.0, 0.0], atol=1e-3)
    output = agent.step(StepInput(predict_ns=3 * _PERIOD_NS), 3 * _PERIOD_NS)
    predicted = pose_sample(agent, output, 0, 0)
    np.testing.assert_allclose(predicted.T_o_b[:3, 3], [0.15, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(predicted.velocity, [1.0, 0.0, 0.0], atol=1e-3)


def test_user_is_told_once_that_no_odometry_arrives() -> None:
    camera = CameraModel(320, 240, _FOCAL_PX, _FOCAL_PX, 159.5, 119.5)
    agent = EkfAgent(
        CameraRig(camera, None, _LEFT, None), AgentConfig(tracker="ekf"), Identity(AgentId(0), 0), NoBaseChannel()
    )
    black, told = np.zeros((240, 320), np.uint8), []
    for k in range(120):
        batch = _odometry(k) if 50 <= k < 60 else None
        output = agent.step(StepInput(Frame(k * _PERIOD_NS, black), odometry=batch), k * _PERIOD_NS)
        told += [k] if any(event.startswith("odometer") for event in output.events) else []
    assert len(told) == 2
    assert told[0] == 20 and 79 <= told[1] <= 86


def test_tracker_is_chosen_by_option() -> None:
    assert agent_config("").tracker == "map"
    assert agent_config("", tracker="ekf").tracker == "ekf"


def _flow(config: EkfConfig | None = None) -> tuple[CornerFlow, U8]:
    """Corners of an image of squares."""
    rng = np.random.default_rng(0)
    image = np.kron(rng.integers(0, 256, (60, 80)), np.ones((4, 4))).astype(np.uint8)
    image = cv2.GaussianBlur(image, (5, 5), 1.0)
    camera = RectifiedCamera(320, 240, 200.0, 200.0, 159.5, 119.5, 0.1, False, np.eye(4))
    flow = CornerFlow(camera, DetectorConfig(levels=1), config or EkfConfig())
    flow.replenish(build_pyramid(image, 3), np.eye(4))
    assert len(flow.ids) > 20
    return flow, image


def test_no_more_corners_are_followed_than_is_asked() -> None:
    assert len(_flow(EkfConfig(corners=24))[0].ids) == 24 < len(_flow()[0].ids)


def test_corner_is_brought_back_to_its_template_or_dropped() -> None:
    flow, image = _flow()
    uv, ids = flow.uv.copy(), flow.ids.copy()
    flow.uv[3] += [1.2, -0.8]  # as flow drifts
    flow.uv[5] += [40.0, 0.0]
    flow.align(build_pyramid(image, 3), np.eye(4), np.zeros(len(ids)))
    assert int(ids[5]) not in flow.ids.tolist()
    _, at, now = np.intersect1d(ids, flow.ids, return_indices=True)
    assert 3 in at.tolist()
    assert np.abs(flow.uv[now] - uv[at]).max() < 0.05


def test_template_follows_rotation_and_distance() -> None:
    flow, image = _flow()
    turn = se3.so3_exp(np.array([0.0, 0.0, 0.5]))  # about the optical axis
    zoom = 1.3  # a wall at 4 m is now at 4 m / 1.3
    T_o_c = se3.from_rt(turn, np.array([0.0, 0.0, 4.0 - 4.0 / zoom]))
    linear = zoom * turn[:2, :2].T
    centre = np.array([159.5, 119.5])
    seen = cv2.warpAffine(image, np.column_stack([linear, centre - linear @ centre]), (320, 240))
    expected = (flow.uv - centre) @ linear.T + centre
    inside = np.flatnonzero((np.abs(expected - centre) < [120.0, 80.0]).all(axis=1))
    ids = flow.ids[inside]
    flow.drop(np.setdiff1d(flow.ids, ids))
    flow.uv = expected[inside] + 0.5
    flow.align(build_pyramid(seen, 3), T_o_c, np.full(len(ids), 4.0 / zoom))
    _, at, now = np.intersect1d(ids, flow.ids, return_indices=True)
    assert len(now) > 0.8 * len(ids) > 5
    assert np.median(np.linalg.norm(flow.uv[now] - expected[inside][at], axis=1)) < 0.1

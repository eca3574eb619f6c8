"""What corrections move the whole map by is left out of the live pose; what changes its shape is not."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_agent.config import AgentConfig, SmoothingConfig
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.exchange.whole_map_motion import WholeMapMotion
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.pose_report import PoseReport
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_codec.schema import KeyframeHeader, KeyframePose, SubmapPlacement
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, submap_id
from tests.agent.plain_landmarks import plain_landmarks

SECOND_NS = 1_000_000_000
SMALL = se3.exp(np.array([0.003, -0.002, 0.001, 0.0005, -0.001, 0.0015]))  # within all limits


def keyframes(rng: np.random.Generator, n: int = 6) -> F64:
    return np.array([se3.exp(np.concatenate([rng.uniform(-2.0, 2.0, 3), rng.normal(0.0, 0.3, 3)])) for _ in range(n)])


@given(st.integers(0, 1 << 30), st.sampled_from([1.0, 0.3, 2.5]))
def test_a_map_that_moves_as_a_whole_moves_no_live_pose(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    before, S_w_m = keyframes(rng), sim3.of(scale, se3.exp(rng.normal(0.0, 0.5, 6)))
    whole = WholeMapMotion(SmoothingConfig(whole_rad=0.1, whole_m=1.0))
    whole.add(before, SMALL @ before, S_w_m)
    assert np.allclose(whole.leave_out(S_w_m, before[-1, :3, 3]) @ SMALL @ before, S_w_m @ before, atol=1e-9)


def test_one_motion_after_the_other_is_left_out() -> None:
    rng, whole = np.random.default_rng(2), WholeMapMotion(SmoothingConfig(whole_rad=3.0, whole_m=50.0))
    before, S_w_m = keyframes(rng), sim3.of(0.5, se3.exp(rng.normal(0.0, 0.5, 6)))
    poses = before
    for _ in range(3):
        moved = se3.exp(rng.normal(0.0, 0.3, 6)) @ poses
        whole.add(poses, moved, S_w_m)
        poses = moved
    assert np.allclose(whole.leave_out(S_w_m, poses[-1, :3, 3]) @ poses, S_w_m @ before, atol=1e-9)


@given(st.integers(0, 1 << 30))
def test_several_motions_add_up_to_no_more_than_the_limits(seed: int) -> None:
    rng, config = np.random.default_rng(seed), SmoothingConfig()
    poses, whole = keyframes(rng), WholeMapMotion(config)
    for _ in range(8):
        moved = se3.exp(rng.normal(0.0, 0.01, 6)) @ poses
        whole.add(poses, moved, np.eye(4))
        poses = moved
    T_v_w, at = whole.leave_out(np.eye(4), np.zeros(3)), poses[-1:, :3, 3]
    assert np.linalg.norm(se3.so3_log(T_v_w[:3, :3])) <= config.whole_rad + 1e-9
    assert np.linalg.norm(se3.transform(T_v_w, at) - at) <= config.whole_m + 1e-9


@pytest.mark.parametrize("on_m", [5.0, 50.0, 500.0])
def test_a_vehicle_that_flies_on_without_corrections_stays_near_the_world(on_m: float) -> None:
    config, poses = SmoothingConfig(), keyframes(np.random.default_rng(1))
    whole = WholeMapMotion(config)
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.004]))
    whole.add(poses, turn @ poses, np.eye(4))
    off_m, turned_rad = [], []
    for x in np.arange(0.0, on_m, 0.5):
        T_v_w, at = whole.leave_out(np.eye(4), np.array([x, 0.0, 0.0])), np.array([[x, 0.0, 0.0]])
        off_m.append(float(np.linalg.norm(se3.transform(T_v_w, at) - at)))
        turned_rad.append(float(np.linalg.norm(se3.so3_log(T_v_w[:3, :3]))))
    assert max(off_m) <= 2.0 * config.whole_m + 1e-9
    assert np.allclose(turned_rad, 0.004, atol=1e-9)


def test_a_map_that_is_placed_far_away_stays_near_the_world() -> None:
    config, poses = SmoothingConfig(), keyframes(np.random.default_rng(1))
    whole = WholeMapMotion(config)
    whole.add(poses, SMALL @ poses, np.eye(4))
    S_w_m, at = se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, 2.0])), np.array([300.0, -200.0, 0.0])), poses[-1:, :3, 3]
    off = se3.transform(whole.leave_out(S_w_m, at[0]), at) - se3.transform(S_w_m, at)
    assert np.linalg.norm(off) <= config.whole_m + 1e-9


def test_a_change_of_shape_is_a_correction() -> None:
    """A path that was too long: its ends move, its middle does not."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5.0)
    shorter = poses.copy()
    shorter[:, 0, 3] = 2.0 + 0.99 * (poses[:, 0, 3] - 2.0)
    whole = WholeMapMotion(SmoothingConfig())
    whole.add(poses, shorter, np.eye(4))
    assert np.allclose(whole.leave_out(np.eye(4), np.zeros(3)), np.eye(4), atol=1e-12)


def test_keyframes_on_a_line_tell_the_roll_about_it() -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5.0)
    roll = se3.exp(np.array([0.0, 0.0, 0.0, 0.002, 0.0, 0.0]))
    whole = WholeMapMotion(SmoothingConfig())
    whole.add(poses, roll @ poses, np.eye(4))
    assert np.allclose(whole.leave_out(roll, np.zeros(3)), np.eye(4), atol=1e-9)


def test_off_and_with_too_few_keyframes_nothing_is_left_out() -> None:
    poses = keyframes(np.random.default_rng(0))
    for config, n in ((SmoothingConfig(whole_rad=0.0), 6), (SmoothingConfig(), 2)):
        whole = WholeMapMotion(config)
        whole.add(poses[:n], SMALL @ poses[:n], np.eye(4))
        assert np.array_equal(whole.leave_out(np.eye(4), np.zeros(3)), np.eye(4))


SUBMAP = submap_id(AgentId(0), 1, 0)


def flown(rng: np.random.Generator) -> tuple[Corrections, LocalMap]:
    """An agent with five keyframes in a placed submap, and what it has said once."""
    camera, config = RectifiedCamera(752, 480, 450.0, 450.0, 370.0, 240.0, 0.11, True, np.eye(4)), AgentConfig()
    local_map = LocalMap(camera, config.local_map)
    local_map.activate(SUBMAP)
    n, uv = 20, rng.uniform((80.0, 60.0), (680.0, 420.0), (20, 2))
    for k, T_m_k in enumerate(keyframes(rng, 5)):
        local_map.add(
            KeyframeHeader(keyframe_id(SUBMAP, k), k, NO_KEYFRAME, T_m_k, n), T_m_k,
            plain_landmarks(uv, 0.3), k,
        )  # fmt: skip
    corrections = Corrections(local_map, MapCache(camera, config.map_cache, None), config.smoothing)
    corrections.take([SubmapPlacement(SUBMAP, np.eye(4))], [])
    return corrections, local_map


def moved_by(local_map: LocalMap, motions: F64) -> list[KeyframePose]:
    return [KeyframePose(KeyframeId(int(local_map.keyframe[k])), T @ local_map.T_m_k[k]) for k, T in enumerate(motions)]


@pytest.mark.parametrize("drift_m", [0.0, 0.3])
def test_live_poses_follow_a_loop_closure_but_no_turn_of_the_map(drift_m: float) -> None:
    """The camera is tracked at the last keyframe, which corrections move along with the odometry frame's map."""
    corrections, local_map = flown(np.random.default_rng(5))
    held = local_map.T_m_k[4].copy()
    said = corrections.in_world(SUBMAP, held, np.eye(4), SECOND_NS, metric=True)
    drift = se3.from_rt(np.eye(3), np.array([0.0, drift_m, 0.0]))
    share = [se3.from_rt(np.eye(3), drift[:3, 3] * k / 4.0) for k in range(5)]  # more along the path, none at home
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.001, -0.002, 0.002]))
    moved, _ = corrections.take(moved_by(local_map, np.array([turn @ s for s in share])), [])
    assert moved
    T_o_m = held @ se3.inverse(local_map.T_m_k[4])  # odometry does not move
    for n in range(2, 1200):
        now = corrections.in_world(SUBMAP, local_map.T_m_k[4], T_o_m, SECOND_NS + n * 50_000_000, metric=True)
    off_m = float(np.linalg.norm(now[:3, 3] - (drift @ said)[:3, 3]))
    if drift_m == 0.0:
        assert off_m < 1e-3  # of 6 mm that the turn moves it
        assert np.linalg.norm(local_map.T_m_k[4][:3, 3] - held[:3, 3]) > 4e-3
    else:
        assert off_m < 0.08 * drift_m + 0.02  # what drifted, but for what is the whole map's


def test_tiles_are_read_where_the_base_has_the_vehicle_while_the_live_pose_follows_slowly() -> None:
    corrections, local_map = flown(np.random.default_rng(5))
    held = local_map.T_m_k[4].copy()
    estimate = SimpleNamespace(keyframe=KeyframeId(int(local_map.keyframe[4])), T_k_c=np.eye(4))
    camera = MagicMock(T_m_b=held, reference=estimate)
    camera.submaps.active, camera.pose.T_o_m, camera.motion.metric = SUBMAP, np.eye(4), True
    camera.motion.awaits_scale = False
    camera.covariance.of_poses.return_value, camera.covariance.quality.return_value = (np.eye(6), np.eye(6)), 50
    camera.covariance.dead_reckoning_quality.return_value = 100
    report = PoseReport(AgentId(0), camera, corrections, MagicMock(), has_depth=True)
    outcome = MagicMock(tracked=True, inliers=50, T_o_n=None)
    report.report(MagicMock(t_ns=SECOND_NS), outcome)
    step = np.array([0.0, 0.3, 0.0])
    corrections.take(moved_by(local_map, np.array([se3.from_rt(np.eye(3), step * k / 4.0) for k in range(5)])), [])
    camera.T_m_b = local_map.T_m_k[4]
    camera.pose.T_o_m = held @ se3.inverse(local_map.T_m_k[4])  # odometry does not move
    said = report.report(MagicMock(t_ns=SECOND_NS + 50_000_000), outcome)
    of_tiles = report.in_base_map(said.T_o_b)
    assert np.allclose(of_tiles, local_map.T_m_k[4], atol=1e-9)
    assert np.linalg.norm(said.T_w_b[:3, 3] - of_tiles[:3, 3]) > 0.2

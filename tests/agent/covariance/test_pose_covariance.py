"""How certain poses are: errors of calibration carried along, noise that adds up, times without images."""

import math
from typing import Any

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig, CovarianceConfig, LocalMapConfig
from kiteline_agent.covariance import calibration_error_kernels as certainty_kernels
from kiteline_agent.covariance.calibration_error_kernels import adjoint
from kiteline_agent.covariance.pose_covariance import PoseCovariance
from kiteline_agent.covariance.pose_quality import LOST_BELOW, probability_good
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.step import Identity
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_core.ids import AgentId, KeyframeId, SubmapId
from tests.agent.seen_scenes import CAMERA, SHAPES, map_of, scene, seen_with, tracked

X, NOTHING = scene(), np.zeros(SHAPES)  # points, and no error of calibration
UNTOLD = np.zeros((5, 5))  # information about the offset of a good calibration
T_C_M = se3.exp(np.array([0.3, -0.1, 0.2, 0.05, -0.1, 0.08]))


def begun(error: F64 = NOTHING, T_m_k: F64 | None = None, has_body: bool = False, **config: float) -> Any:
    """A map of one keyframe as a rig with an error sees it, and the covariance of poses in it."""
    local_map = map_of(seen_with(error, X, np.eye(4)), T_m_k)
    of_poses = PoseCovariance(local_map, np.eye(4), CovarianceConfig(**config), has_body=has_body, has_depth=True)
    return local_map, of_poses


def tracked_at(local_map: LocalMap, T_c_m: F64, error: F64 = NOTHING) -> Track:
    return tracked(local_map, seen_with(error, X, T_c_m), T_c_m)


@pytest.mark.parametrize("shape", range(certainty_kernels.CALIBRATION))
def test_what_an_error_of_calibration_does_to_a_pose_is_foreseen(shape: int) -> None:
    error = np.zeros(SHAPES)
    error[shape] = 0.05
    local_map, covariance = begun(error)
    track = tracked_at(local_map, T_C_M, error)
    covariance.update(track)
    moved = se3.log(se3.inverse(track.T_c_m) @ T_C_M)  # on the left of T_m_c
    np.testing.assert_allclose(covariance._shift @ error, moved, atol=0.04 * np.abs(moved).max() + 2e-6)
    assert np.abs(moved).max() > 1e-5


def test_a_disparity_offset_that_was_found_moves_the_camera_to_where_it_is() -> None:
    offset = np.array([0.3, -0.1, 0.2, 0.15, 0.1])
    error, edge = np.zeros(SHAPES), 376.0 / CAMERA.fx
    error[:5] = offset * [1.0, edge, edge, edge**2, edge**2]
    local_map, covariance = begun(error)
    track = tracked_at(local_map, T_C_M, error)
    covariance.update(track)
    T_m_c = se3.exp(covariance.correct_disparities(offset)) @ track.T_m_c
    before, after = (np.linalg.norm(se3.log(T_C_M @ T)) for T in (track.T_m_c, T_m_c))
    assert after < 0.1 * before
    np.testing.assert_allclose(local_map.T_m_k[0], np.eye(4), atol=1e-12)  # the first keyframe has no error


def test_a_rig_that_may_be_worn_is_less_certain_until_it_is_known() -> None:
    pose, (local_map, covariance) = PoseState(), begun()
    covariance.update(tracked_at(local_map, T_C_M))
    good = covariance.of_poses(pose, se3.inverse(T_C_M))[0]
    covariance.set_disparity_error(0.2 * np.eye(5), 0.5, UNTOLD)
    doubtful = covariance.of_poses(pose, se3.inverse(T_C_M))[0]
    covariance.set_disparity_error(np.zeros((5, 5)), 0.0, UNTOLD)
    assert np.trace(doubtful[:3, :3]) > 4.0 * np.trace(good[:3, :3])
    assert np.linalg.eigvalsh(doubtful - good)[0] > -1e-12
    np.testing.assert_allclose(covariance.of_poses(pose, se3.inverse(T_C_M))[0], good)


def test_a_good_calibration_s_offset_that_is_followed_leaves_its_posterior() -> None:
    pose, (local_map, covariance) = PoseState(), begun()
    covariance.update(tracked_at(local_map, T_C_M))

    def told(worn: float, information: F64) -> F64:
        covariance.set_disparity_error(np.zeros((5, 5)), worn, information)
        return covariance.of_poses(pose, se3.inverse(T_C_M))[0]

    before = told(0.0, UNTOLD)
    prior = np.linalg.inv(np.diag(covariance._good_variance[:5] / covariance._at_edge**2))
    as_much, certain = told(0.0, prior), told(0.0, 1e9 * np.eye(5))
    np.testing.assert_allclose(before - as_much, 0.5 * (before - certain), rtol=1e-5, atol=1e-12)  # variances halve
    assert np.trace(certain) < 0.5 * np.trace(before)
    half_worn, doubtful = told(0.5, prior), told(0.5, UNTOLD)
    np.testing.assert_allclose(doubtful - half_worn, 0.5 * (before - as_much), rtol=1e-5, atol=1e-12)


def test_rows_without_a_slope_rule_out_a_roll_and_nothing_else() -> None:
    pose, (local_map, covariance) = PoseState(), begun()
    covariance.update(tracked_at(local_map, T_C_M))
    usual = covariance.of_poses(pose, se3.inverse(T_C_M))[0]
    covariance.set_roll(0.02)
    level = covariance.of_poses(pose, se3.inverse(T_C_M))[0]
    assert np.linalg.eigvalsh(usual - level)[0] > -1e-12
    assert np.linalg.matrix_rank(usual - level, tol=1e-6 * np.trace(usual - level)) == 1  # the slope along y
    assert 0.0 < np.trace(usual - level) < 0.5 * np.trace(usual)
    covariance.set_roll(0.5)  # of a worn rig, whose disparities are estimated
    np.testing.assert_allclose(covariance.of_poses(pose, se3.inverse(T_C_M))[0], usual)


def test_disparity_errors_that_cancel_cost_less_than_their_parts() -> None:
    pose, (local_map, covariance) = PoseState(), begun(calibration_px=0.0)
    covariance.update(tracked_at(local_map, T_C_M))
    noise = covariance.of_poses(pose, se3.inverse(T_C_M))[0]

    def added(offset: F64) -> F64:
        covariance.set_disparity_error(np.outer(offset, offset), 0.0, UNTOLD)
        return covariance.of_poses(pose, se3.inverse(T_C_M))[0] - noise

    offset = np.array([0.3, 0.0, 0.0, -0.9, 0.0])  # little is left where the points are
    parts = added(offset * [1, 0, 0, 0, 0]) + added(offset * [0, 0, 0, 1, 0])
    both = added(offset)
    assert np.trace(both[:3, :3]) < 0.5 * np.trace(parts[:3, :3])
    assert np.linalg.matrix_rank(both, tol=1e-6 * np.trace(both)) == 1  # one known direction
    moved = covariance._shift[:, :5] @ (offset * covariance._at_edge)
    left = np.empty((6, 6))
    left[:3, :3], left[:3, 3:], left[3:, 3:] = np.eye(3), -se3.skew(se3.inverse(T_C_M)[:3, 3]), T_C_M[:3, :3]
    left[3:, :3] = 0.0
    np.testing.assert_allclose(both, np.outer(left @ moved, left @ moved), rtol=1e-6, atol=1e-12)


def test_near_its_start_the_covariance_follows_every_few_centimetres() -> None:
    def deviations(step_m: float, frames: int) -> list[float]:
        local_map, covariance = begun()
        covariance.begin_submap(np.eye(4), np.eye(4))
        out = []
        for k in range(frames):
            T_c_m = se3.exp(np.array([k * step_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
            covariance.update(tracked_at(local_map, T_c_m))
            cov = covariance.of_poses(PoseState(), se3.inverse(T_c_m))[0] - covariance._noise
            out.append(math.sqrt(cov[0, 0]))
        return out

    moving = np.array(deviations(0.03, 12))  # a stretched map: errors are a share of the distance
    share = moving[1:] / (0.03 * np.arange(1, 12))
    assert share.min() > 0.6 * share.max() > 0.0
    assert len(set(deviations(1e-4, 12))) == 3  # a camera at rest: every fifth frame


def test_the_error_of_a_keyframe_is_that_of_what_is_measured_against_it() -> None:
    moved = se3.exp(np.array([0.01, -0.02, 0.015, 0.002, -0.003, 0.004]))
    (local_map, covariance), (true_map, alone) = begun(T_m_k=moved), begun()
    covariance._shift_k[0, :, 0] = se3.log(moved)
    covariance.update(tracked_at(local_map, T_C_M))
    alone.update(tracked_at(true_map, T_C_M))
    # observations in the moved map put the camera at moved @ T_m_c: the same perturbation on the left
    np.testing.assert_allclose(covariance._shift[:, 0] - alone._shift[:, 0], se3.log(moved), atol=2e-4)


def test_noise_of_a_measured_pose_is_what_it_says() -> None:
    rng = np.random.default_rng(0)
    local_map, covariance = begun(calibration_px=0.0, least_rms=0.0)
    covariance.begin_submap(np.eye(4), np.eye(4))
    nees = []
    for _ in range(100):
        track = tracked(local_map, seen_with(NOTHING, X, T_C_M) + 0.15 * rng.normal(size=(120, 3)), T_C_M)
        covariance.update(track)
        T = se3.inverse(track.T_c_m)
        good = se3.inverse(T_C_M)
        e = np.concatenate([good[:3, 3] - T[:3, 3], se3.so3_log(T[:3, :3].T @ good[:3, :3])])
        nees.append(e @ np.linalg.solve(covariance.of_poses(PoseState(), T)[0], e))
    assert 5.0 < np.mean(nees) < 7.2


def test_what_an_imu_pulls_poses_by_adds_up_from_keyframe_to_keyframe() -> None:
    local_map, covariance = begun(calibration_px=0.0)
    covariance.begin_submap(np.eye(4), np.eye(4))
    track = tracked_at(local_map, np.eye(4))
    pull = np.array([0.0, 0.0, 0.004, 0.0, 0.001, 0.0])

    def deviation() -> F64:
        covariance._schedule._frames = 100  # evaluated anew
        covariance.update(track)
        return np.sqrt(np.diag(covariance.of_poses(PoseState(), np.eye(4))[0]))

    alone = deviation()
    for _ in range(100):
        covariance.update_imu_offset(np.eye(4), se3.exp(pull))
    np.testing.assert_allclose(deviation()[[2, 4]], pull[[2, 4]], rtol=0.05)
    covariance.store(KeyframeId(0))
    np.testing.assert_allclose(deviation()[[2, 4]], 2.0 * pull[[2, 4]], rtol=0.05)
    for sign in [1.0, -1.0] * 100:  # to and fro, it is noise, which adds up as squares
        covariance.update_imu_offset(np.eye(4), se3.exp(sign * pull))
    covariance._noise_k[:], covariance._shift_k[:] = 0.0, 0.0
    np.testing.assert_allclose(deviation()[[2, 4]], pull[[2, 4]], rtol=0.15)
    assert alone[2] < 0.001


def test_a_wrong_place_in_the_body_shows_once_the_body_turns() -> None:
    _, covariance = begun(has_body=True, calibration_px=0.0, extrinsic_rad=1e-3, extrinsic_m=0.0)
    covariance.begin_submap(np.eye(4), np.eye(4))
    assert not covariance.of_poses(PoseState(), np.eye(4))[0].any()
    half = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi]))
    sigma = np.sqrt(np.diag(covariance.of_poses(PoseState(), half)[0])[3:])
    np.testing.assert_allclose(sigma, [2e-3, 2e-3, 0.0], atol=1e-6)


def test_dead_reckoning_grows_uncertain_and_the_odometry_keeps_it() -> None:
    pose, (local_map, covariance) = PoseState(), begun(has_body=True, calibration_px=0.0)
    covariance.begin_submap(np.eye(4), np.eye(4))
    covariance.update(tracked_at(local_map, np.eye(4)))
    before = covariance.of_poses(pose, np.eye(4))[1]
    sizes = []
    for _ in range(20):
        covariance.dead_reckon(0.05, None)
        sizes.append(covariance.of_poses(pose, np.eye(4))[1][0, 0])
    assert (np.diff(sizes) > 0.0).all()
    assert np.sqrt(sizes[-1]) == pytest.approx(1.0, abs=0.1)  # half of 2 m/s^2 for a second
    covariance.before_map_change(pose, np.eye(4), SubmapId(0))
    pose.move_map(se3.exp(np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.3])))
    covariance.update(tracked_at(local_map, np.eye(4)))
    assert covariance.of_poses(PoseState(), np.eye(4))[0][0, 0] < 1e-4  # seen in the map again
    after = covariance.of_poses(pose, pose.T_m_c)[1]
    assert np.trace(after[:3, :3]) == pytest.approx(3 * sizes[-1], rel=0.05)  # but nobody knows the way there
    assert after[0, 0] > before[0, 0]


def test_what_is_not_known_of_a_path_in_another_unit_is_forgotten_where_metres_begin() -> None:
    rig = CameraRig(CameraModel(640, 480, 400.0, 400.0, 320.0, 240.0), None, np.eye(4), None)
    local_map = LocalMap(CAMERA, LocalMapConfig())
    camera = CameraState(rig, ImuCalibration(), AgentConfig(), Identity(AgentId(0), 0), local_map)
    camera.open_submap()

    def sigma_m(*, metres: bool) -> float:
        """After two seconds without images, where the next submap begins."""
        for _ in range(40):
            camera.covariance.dead_reckon(0.05, None)
        camera.leave_submap()
        if metres:
            camera.begin_metres()
        camera.open_submap()
        return float(np.sqrt(camera.covariance.of_poses(camera.pose, camera.T_m_b)[1][0, 0]))

    assert sigma_m(metres=False) > 1.0
    assert sigma_m(metres=True) < 0.01  # no pose before could be flown
    assert sigma_m(metres=False) > 1.0
    assert sigma_m(metres=True) > 2.0  # the way from the first metres on counts


def test_dead_reckoning_from_an_unknown_speed_is_worse_and_one_by_a_slow_camera_too() -> None:
    sigma = []
    for over_s in (0.0, None, 0.4):
        _, covariance = begun(unknown_velocity_m_s=5.0, unknown_rate_rad_s=1.0)
        covariance.begin_submap(np.eye(4), np.eye(4))
        covariance.dead_reckon(0.3, None, over_s)
        sigma.append(np.sqrt(np.diag(covariance.of_poses(PoseState(), np.eye(4))[0])))
    np.testing.assert_allclose(sigma[0], np.repeat([0.03 * 0.3 + 0.09, 0.02 * 0.3 + 0.09], 3), rtol=1e-6)
    np.testing.assert_allclose(sigma[1], np.repeat([5.0 * 0.3 + 0.09, 1.0 * 0.3 + 0.09], 3), rtol=1e-6)
    np.testing.assert_allclose(sigma[2], sigma[0] + 0.3 * 0.4, rtol=1e-6)  # of 2 m/s^2 since its middle


@pytest.mark.parametrize(("option", "axis"), [("unmeasured_accel_m_s2", 0), ("unmeasured_turn_rad_s2", 3)])
def test_a_livelier_vehicle_is_less_certain_in_the_dark(option: str, axis: int) -> None:
    sigma = []
    for value in (2.0, 4.0):
        _, covariance = begun(calibration_px=0.0, **{option: value})
        covariance.begin_submap(np.eye(4), np.eye(4))
        covariance.dead_reckon(1.0, None)
        sigma.append(np.sqrt(covariance.of_poses(PoseState(), np.eye(4))[0][axis, axis]))
    assert sigma[1] > 1.5 * sigma[0]


def test_how_likely_an_error_is_small() -> None:
    rng = np.random.default_rng(1)
    for sigma in ([0.1, 0.1, 0.1], [0.2, 0.02, 0.05], [0.01, 0.01, 0.01], [1.0, 1.0, 0.1]):
        cov = np.zeros((6, 6))
        cov[:3, :3] = np.diag(np.square(sigma))
        truly = np.mean(np.linalg.norm(rng.normal(size=(20000, 3)) * sigma, axis=1) < 0.2)
        assert probability_good(cov, 0.2, 0.17) == pytest.approx(truly, abs=0.03)
    assert probability_good(np.zeros((6, 6)), 0.2, 0.17) == 1.0


def test_adjoint_carries_a_perturbation_from_right_to_left() -> None:
    T, x = se3.exp(np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.7])), np.array([0.1, 0.2, -0.1, 0.03, 0.2, 0.1])
    np.testing.assert_allclose(se3.exp(adjoint(T) @ x) @ T, T @ se3.exp(x), atol=1e-12)


def test_the_kernel_of_poses_composes_as_written() -> None:
    rng = np.random.default_rng(2)

    def some(n: int) -> F64:
        a = rng.normal(size=(n, n))
        return np.asarray(1e-3 * a @ a.T)

    def pose() -> F64:
        return se3.exp(rng.normal(size=6))

    def to_body(T: F64) -> F64:
        j = np.zeros((6, 6))
        j[:3, :3], j[:3, 3:], j[3:, 3:] = np.eye(3), -se3.skew(T[:3, 3]), T[:3, :3].T
        return j

    noise, carried, blind, extrinsic = some(6), some(6), some(6), some(6)
    shift, calibration = rng.normal(size=(6, SHAPES)), some(SHAPES)
    T_a_m, T_m_b, T_a_b0 = pose(), pose(), pose()
    left, out = np.empty((6, 6)), np.empty((6, 6))
    certainty_kernels.pose_covariance(
        noise, shift, calibration, carried, blind, extrinsic, T_a_m, T_m_b, T_a_b0, left, out
    )  # fmt: skip
    T_a_b = T_a_m @ T_m_b
    a, j, turn = adjoint(T_a_m), to_body(T_a_b), np.eye(6)
    turn[:3, :3] = T_a_m[:3, :3]
    want = carried + a @ (noise + shift @ calibration @ shift.T) @ a.T
    np.testing.assert_allclose(left, want, rtol=1e-10)
    e = j @ adjoint(T_a_b0) @ (np.eye(6) - adjoint(se3.inverse(T_a_b0) @ T_a_b))
    np.testing.assert_allclose(out, j @ want @ j.T + turn @ blind @ turn.T + e @ extrinsic @ e.T, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("rate_hz", [5.0, 20.0])
def test_low_quality_after_a_far_relocalisation_lasts_as_long_at_any_frame_rate(rate_hz: float) -> None:
    local_map, covariance = begun()
    track = tracked_at(local_map, np.eye(4))
    covariance.far_relocalisation = True
    covariance.confirm_relocalisation()
    frames, sure = 0, 1e-8 * np.eye(6)
    while covariance.quality(sure, 100) < LOST_BELOW and frames < 100:
        covariance.update(track, 1.0 / rate_hz)
        frames += 1
    assert frames == rate_hz  # one second

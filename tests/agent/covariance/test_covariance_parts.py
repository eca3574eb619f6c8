"""Parts of the covariance of poses against dense algebra: frames, signs and shares of each."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_agent.config import CovarianceConfig
from kiteline_agent.covariance import calibration_error_kernels as kernels
from kiteline_agent.covariance.odometry_drift import covariance_by_map
from kiteline_agent.covariance.pose_covariance import PoseCovariance
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId, SubmapId
from tests.agent.seen_scenes import CAMERA, SHAPES, map_of, scene, seen_with, tracked
from tests.core.helpers_from_python import from_python

INTRINSICS, HALF_PX = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.bf]), 376.0
T_C_M = se3.exp(np.array([0.3, -0.1, 0.2, 0.05, -0.1, 0.08]))
ELSEWHERE = se3.exp(np.array([2.0, -1.0, 0.5, 0.3, -0.6, 1.1]))
MOVED = se3.exp(np.array([3.0, 1.0, -2.0, 0.2, 0.4, -0.9]))


def some_cov(seed: int, size: float = 0.1) -> F64:
    half = size * np.random.default_rng(seed).normal(size=(6, 6))
    return np.asarray(half @ half.T)


def begun(**config: float) -> PoseCovariance:
    """The covariance in a map of one keyframe that begins at the origin."""
    local_map = map_of(seen_with(np.zeros(SHAPES), scene(), np.eye(4)))
    covariance = PoseCovariance(local_map, np.eye(4), CovarianceConfig(**config), has_body=False, has_depth=True)
    covariance.begin_submap(np.eye(4), np.eye(4))
    return covariance


def see(covariance: PoseCovariance, T_c_m: F64 = T_C_M) -> F64:
    """Track a frame; T_m_b."""
    track = tracked(covariance._map, seen_with(np.zeros(SHAPES), scene(), T_c_m), T_c_m)
    covariance._evaluate(track)
    return se3.inverse(track.T_c_m)


def in_odometry(pose: PoseState, cov: F64) -> F64:
    """A covariance of [translation in m, body's rotation] as one of [translation in o, body's rotation]."""
    turn = np.eye(6)
    turn[:3, :3] = pose.T_o_m[:3, :3]
    return np.asarray(turn @ cov @ turn.T)


# what errors of the calibration do to pixels, and pixels to the pose


def pixels(p: F64, focal: F64, centre: F64, bf: float, lens: float) -> F64:
    xy = p[:2] / p[2]
    r2 = float(xy @ xy)
    return np.append(focal * xy * (1.0 + lens * r2) + centre, bf / p[2])


@pytest.mark.parametrize("shape", range(5, 10))
def test_errors_of_both_cameras_are_those_of_their_numbers(shape: int) -> None:
    """One pixel at the image's edge, by a focal length, a principal point or the distortion of both cameras."""
    focal, centre, p = INTRINSICS[:2].copy(), INTRINSICS[2:4].copy(), np.array([0.4, -0.3, 2.0])
    before = pixels(p, focal, centre, CAMERA.bf, 0.0)
    small, edge, bf, lens = 1e-3, HALF_PX / CAMERA.fx, CAMERA.bf, 0.0
    if shape in (5, 6):
        focal[shape - 5] += small / edge
    elif shape in (7, 8):
        centre[shape - 7] += small
    else:
        lens = small / (edge**3 * CAMERA.fx)  # cubic in the place
    if shape == 5:
        bf *= focal[0] / CAMERA.fx
    out = np.empty((3, SHAPES))
    from_python(kernels.bias_error)(*before, INTRINSICS, HALF_PX, out)
    off = (pixels(p, focal, centre, bf, lens) - before) / small
    np.testing.assert_allclose(out[:, shape], off, atol=1e-6)


@settings(max_examples=5)
@given(st.integers(0, 1 << 30))
def test_sensitivities_are_those_of_a_dense_reference(seed: int) -> None:
    """Points hang on keyframes with errors of their own, and their depths are uncertain along a ray."""
    rng, n = np.random.default_rng(seed), 8
    T_m_k = np.array([se3.exp(0.1 * rng.normal(size=6)) for _ in range(2)])
    of_keyframes, per = 1e-3 * rng.normal(size=(2, 6, SHAPES)), 6
    anchor, rho = rng.uniform([80.0, 60.0], [680.0, 420.0], (2 * per, 2)), rng.uniform(0.2, 0.5, 2 * per)
    rows, ray, sigma = rng.permutation(2 * per)[:n], 0.05 * rng.normal(size=(n, 3)), rng.uniform(0.3, 0.8, n)
    bias = from_python(kernels.bias_error)

    def point(row: int, error: F64) -> F64:
        """Of a row, as a map sees it whose calibration errs."""
        there, slot = np.empty((3, SHAPES)), row // per
        bias(*anchor[row], CAMERA.bf * rho[row], INTRINSICS, HALF_PX, there)
        u, v, disparity = np.append(anchor[row], CAMERA.bf * rho[row]) + there @ error
        local = CAMERA.bf / disparity * np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        return se3.transform(se3.exp(of_keyframes[slot] @ error) @ T_m_k[slot], local[None])[0]

    def project(x: F64, p: F64) -> F64:
        return pixels(se3.transform(se3.exp(x) @ T_C_M, p[None])[0], INTRINSICS[:2], INTRINSICS[2:4], CAMERA.bf, 0.0)

    zero, none, step = np.zeros(6), np.zeros(SHAPES), 1e-6
    xyz = np.array([point(row, none) for row in rows])
    observed = np.array([project(zero, p) for p in xyz]) + 0.5 * rng.normal(size=(n, 3))
    observed[::3, 2] = -1.0
    want = np.zeros((6 + SHAPES, 6 + SHAPES)), np.zeros(6 + SHAPES)
    for i, row in enumerate(rows.tolist()):
        here, used = np.empty((3, SHAPES)), 3 if observed[i, 2] >= 0.0 else 2
        bias(*observed[i], INTRINSICS, HALF_PX, here)
        by_pose = [project(step * d, xyz[i]) - project(-step * d, xyz[i]) for d in np.eye(6)]
        by_error = [project(zero, point(row, step * d)) - project(zero, point(row, -step * d)) for d in np.eye(SHAPES)]
        j = np.column_stack([*by_pose, *by_error]) / (2 * step)
        j[:, 6:] -= here
        along = (project(zero, xyz[i] + step * ray[i]) - project(zero, xyz[i] - step * ray[i])) / (2 * step)
        j, along, r = j[:used], along[:used], (project(zero, xyz[i]) - observed[i])[:used]
        weight = np.linalg.inv(sigma[i] ** 2 * np.eye(used) + np.outer(along, along))
        want[0][:] += j.T @ weight @ j
        want[1][:] += j.T @ weight @ r
    h, g, of_errors, side = np.empty((6, 6)), np.empty((6, SHAPES)), np.empty((10, 10)), np.empty(16)
    kernels.sensitivity(
        T_C_M, INTRINSICS, HALF_PX, rows, np.ones(n, np.bool_), xyz, ray, observed, sigma, per, T_m_k, anchor, rho,
        of_keyframes, h, g, of_errors, side,
    )  # fmt: skip
    for got, expected in (
        (h, want[0][:6, :6]), (g, want[0][:6, 6:]), (of_errors, want[0][6:16, 6:16]), (side, want[1][:16])
    ):  # fmt: skip
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


# what poses are measured against


def test_poses_have_the_noise_of_their_keyframes_by_the_share_of_their_landmarks() -> None:
    covariance = begun(calibration_px=0.0)
    m, half = covariance._map, len(scene()) // 2
    for array in (m.uv, m.rho, m.bearing, m.T_m_k):
        array[1] = array[0]
    track = tracked(m, seen_with(np.zeros(SHAPES), scene(), T_C_M), T_C_M)
    covariance._evaluate(track)
    own = covariance._noise
    covariance._noise_k[0], covariance._noise_k[1] = some_cov(1), some_cov(2)
    track.rows[:half] += m.slot_size
    covariance._evaluate(track)
    np.testing.assert_allclose(covariance._noise - own, 0.5 * (some_cov(1) + some_cov(2)), rtol=1e-6, atol=1e-9)


def test_the_imu_s_pull_couples_rotation_and_translation_as_poses_do() -> None:
    covariance = begun(calibration_px=0.0)
    pull = np.array([0.01, -0.004, 0.006, 0.002, -0.003, 0.001])
    for _ in range(400):
        covariance.update_imu_offset(np.eye(4), se3.exp(pull))
    T_m_b = see(covariance, np.eye(4))
    np.testing.assert_allclose(covariance.of_poses(PoseState(), T_m_b)[0], np.outer(pull, pull), rtol=0.1, atol=3e-6)


def test_a_worn_lens_adds_errors_of_focal_lengths_and_centre() -> None:
    covariance = begun()
    T_m_b, none = see(covariance), np.zeros((5, 5))
    covariance.set_disparity_error(none.copy(), 0.0, none)
    good = covariance.of_poses(PoseState(), T_m_b)[0]
    covariance.set_disparity_error(none.copy(), 0.5, none)
    j = np.linalg.inv(kernels.from_body(T_m_b)) @ covariance._shift[:, 5:9]
    np.testing.assert_allclose(covariance.of_poses(PoseState(), T_m_b)[0] - good, 0.5 * 0.8**2 * j @ j.T, rtol=1e-6)


def test_a_new_disparity_offset_takes_its_effect_from_keyframes() -> None:
    covariance, offset = begun(), np.array([0.3, -0.1, 0.2, 0.15, 0.1])
    m, shift = covariance._map, 0.02 * np.random.default_rng(3).normal(size=(6, SHAPES))
    covariance._shift_k[0] = shift
    m.T_m_k[0] = se3.exp(shift[:, :5] @ (covariance._at_edge * offset)) @ ELSEWHERE
    told = m.T_m_k[0].copy()
    covariance.correct_disparities(offset)
    np.testing.assert_allclose(m.T_m_k[0], ELSEWHERE, atol=1e-12)
    np.testing.assert_allclose(m.held.offsets.moved(told, 0, 0, {}), ELSEWHERE, atol=1e-12)  # as poses of the base will


# dead reckoning, and changes of the map


def test_a_map_that_dead_reckoning_extends_is_as_uncertain_as_that() -> None:
    covariance, sensor = begun(calibration_px=0.0), some_cov(4)
    see(covariance)
    before = covariance.of_poses(PoseState(), ELSEWHERE)[0]
    covariance.dead_reckon(0.1, sensor)
    np.testing.assert_allclose(covariance.of_poses(PoseState(), ELSEWHERE)[0], before + sensor, atol=1e-12)
    covariance.extend_map(ELSEWHERE)
    np.testing.assert_allclose(covariance.of_poses(PoseState(), ELSEWHERE)[0], before + sensor, atol=1e-12)


def test_the_odometry_frame_keeps_what_dead_reckoning_added_before_the_map_changed() -> None:
    covariance, pose, sensor = begun(calibration_px=0.0), PoseState(), some_cov(5)
    pose.T_m_c, pose.T_o_m = ELSEWHERE, MOVED
    covariance.dead_reckon(0.1, sensor)
    covariance.before_map_change(pose, np.eye(4), SubmapId(0))
    covariance._reset_reckoning()
    pose.move_map(se3.exp(np.array([0.4, 0.1, -0.2, 0.1, 0.2, 0.3])) @ pose.T_m_c)
    cov_o = covariance.of_poses(pose, pose.T_m_c)[1]
    was = PoseState()
    was.T_o_m = MOVED
    np.testing.assert_allclose(cov_o, in_odometry(was, sensor), atol=1e-9)


def test_what_the_base_refines_makes_the_map_more_certain_and_odometry_not() -> None:
    covariance, pose = begun(calibration_px=0.0), PoseState()
    T_m_b = see(covariance)
    pose.T_m_c, pose.T_o_m = T_m_b, MOVED
    covariance.store(KeyframeId(0))
    covariance._same_frame = False
    cov_m, cov_o = covariance.of_poses(pose, T_m_b)
    kept = covariance._noise_k[0].copy()
    covariance._map.from_base[0] = True
    covariance.apply_refinement(pose)
    after_m, after_o = covariance.of_poses(pose, T_m_b)
    np.testing.assert_allclose(after_m, 0.25 * cov_m, rtol=1e-9)
    np.testing.assert_allclose(after_o, cov_o, rtol=1e-9)
    np.testing.assert_allclose(covariance._noise_k[0], 0.25 * kept)
    covariance.apply_refinement(pose)  # once a keyframe
    np.testing.assert_allclose(covariance._noise_k[0], 0.25 * kept)


def test_a_pose_from_the_map_cache_has_the_noise_of_its_pixels_in_the_camera() -> None:
    covariance = begun(calibration_px=0.0)
    covariance.relocalise(KeyframeId(0), T_C_M, 25)
    turn = 1.0 / CAMERA.fx / 5.0
    own = np.diag(np.repeat([4.0 * turn, turn], 3) ** 2)
    T_m_b = se3.inverse(T_C_M)
    j = np.linalg.inv(kernels.from_body(T_m_b)) @ kernels.adjoint(T_m_b)
    np.testing.assert_allclose(covariance.of_poses(PoseState(), T_m_b)[0], j @ own @ j.T, rtol=1e-9, atol=1e-15)


def test_drift_of_the_odometry_frame_is_told_in_its_axes_and_in_the_body_s() -> None:
    cov_m, T_o_m = some_cov(6), se3.exp(np.array([0.3, -0.2, 0.1, 0.02, -0.03, 0.4]))
    T_o_b = T_o_m @ ELSEWHERE
    off_m, off_rad = T_o_b[:3, 3] - ELSEWHERE[:3, 3], se3.so3_log(ELSEWHERE[:3, :3].T @ T_o_b[:3, :3])
    pose = PoseState()
    pose.T_o_m = T_o_m
    expected = in_odometry(pose, cov_m)
    expected[:3, :3] += np.outer(off_m, off_m)
    expected[3:, 3:] += np.outer(off_rad, off_rad)
    np.testing.assert_allclose(covariance_by_map(cov_m, T_o_m, ELSEWHERE), expected, atol=1e-12)


# places that contradict the way there


def flown_away() -> tuple[PoseCovariance, PoseState]:
    """A vehicle with an IMU that left submap 0, whose map moved then, and is uncertain about one of its axes."""
    covariance, pose = begun(calibration_px=0.0), PoseState()
    pose.T_m_c = ELSEWHERE
    covariance.set_imu_motion(measured=True)
    covariance.before_map_change(pose, np.eye(4), SubmapId(0))
    pose.move_map(MOVED)
    covariance.dead_reckon(0.1, np.diag([1e-4, 1e-4, 1e-4, 0.3**2, 1e-6, 1e-6]))
    return covariance, pose


@pytest.mark.parametrize(("off_m", "consistent"), [(0.3, True), (1.0, False)])
def test_a_submap_that_was_left_is_where_odometry_left_it(off_m: float, consistent: bool) -> None:
    covariance, pose = flown_away()
    T_m_c = se3.from_rt(np.eye(3), np.array([0.0, off_m, 0.0])) @ ELSEWHERE  # in submap 0, whose frame was o
    found = covariance.is_consistent(
        se3.inverse(T_m_c), SubmapId(0), pose.T_m_c, pose, np.eye(4), SubmapId(1), relocalised=True
    )
    assert found is consistent


@pytest.mark.parametrize(("axis", "consistent"), [(0, True), (1, False)])
def test_turns_are_judged_about_the_axes_of_the_body(axis: int, consistent: bool) -> None:
    covariance, pose = flown_away()
    T_m_c = ELSEWHERE @ se3.exp(np.eye(6)[3 + axis])
    found = covariance.is_consistent(
        se3.inverse(T_m_c), SubmapId(0), pose.T_m_c, pose, np.eye(4), SubmapId(1), relocalised=True
    )
    assert found is consistent

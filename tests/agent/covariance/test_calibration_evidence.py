"""What residuals tell of errors of the calibration, and how they widen the covariance."""

import numpy as np
import pytest

from kiteline_agent.config import CovarianceConfig
from kiteline_agent.covariance import calibration_error_kernels as certainty_kernels
from kiteline_agent.covariance.calibration_evidence import CalibrationEvidence
from kiteline_agent.covariance.pose_covariance import PoseCovariance
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from tests.agent.seen_scenes import SHAPES, map_of, scene, seen_with, tracked

VIEWS = [np.array([0.3 * x, 0.2 * y, 0.4 * z, 0.05 * y, -0.1 * x, 0.08 * z])
         for x, y, z in np.random.default_rng(5).uniform(-1.0, 1.0, (12, 3))]  # fmt: skip


def evidence_of(error: F64, noise_px: float = 0.0) -> tuple[CalibrationEvidence, F64, F64]:
    """The evidence of twelve views with an error of calibration, each seen often; sums of information and side."""
    rng = np.random.default_rng(6)
    X = scene()
    local_map = map_of(seen_with(error, X, np.eye(4)))
    m, variance = local_map, np.full(certainty_kernels.CALIBRATION, 0.05**2)
    evidence, information, side = CalibrationEvidence(variance), np.zeros((10, 10)), np.zeros(10)
    for view in VIEWS * 4:
        T_c_m = se3.exp(view)
        observed = seen_with(error, X, T_c_m)
        track = tracked(local_map, observed + noise_px * rng.normal(size=observed.shape), T_c_m)
        h, g, of_errors, s = np.empty((6, 6)), np.empty((6, SHAPES)), np.empty((10, 10)), np.empty(16)
        certainty_kernels.sensitivity(
            track.T_c_m, m.intrinsics, 376.0, track.rows, track.inlier, track.xyz, track.ray, track.observed,
            track.sigma_px, m.slot_size, m.T_m_k, m.uv.reshape(-1, 2), m.rho.reshape(-1),
            np.zeros((len(m.keyframe), 6, SHAPES)), h, g, of_errors, s,
        )  # fmt: skip
        evidence.add(h, g, of_errors, s)
        to_pose = np.linalg.solve(h, g[:, :10]).T
        information += of_errors - to_pose @ g[:, :10]
        side += s[6:] - to_pose @ s[:6]
    return evidence, information, side


@pytest.mark.parametrize("shape", [0, 1, 3])
def test_errors_of_calibration_are_found_in_the_residuals(shape: int) -> None:
    error = np.zeros(SHAPES)
    error[shape] = 0.2
    evidence, information, side = evidence_of(error)
    np.testing.assert_allclose(16.0 * evidence._information, information, rtol=1e-3, atol=1e-4 * information.max())
    np.testing.assert_allclose(16.0 * evidence._side, side, rtol=1e-3, atol=1e-4 * np.abs(side).max())  # inflated
    np.testing.assert_allclose(information, information.T, rtol=1e-9)
    found = np.linalg.solve(information + np.eye(10), side)
    np.testing.assert_allclose(found[shape], 0.2, atol=0.03)


def test_evidence_is_what_is_left_of_residuals_once_the_pose_is_free() -> None:
    rng = np.random.default_rng(1)
    half, side = rng.normal(size=(30, 16)), rng.normal(size=16)
    joint, evidence = half.T @ half, CalibrationEvidence(np.full(10, 0.05**2))
    g = np.column_stack([joint[:6, 6:], np.zeros(6)])
    evidence.add(joint[:6, :6], g, joint[6:, 6:], side)
    gain = joint[6:, :6] @ np.linalg.inv(joint[:6, :6])
    np.testing.assert_allclose(16.0 * evidence._information, joint[6:, 6:] - gain @ joint[:6, 6:], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(16.0 * evidence._side, side[6:] - gain @ side[:6], rtol=1e-5, atol=1e-5)


def test_a_worn_calibration_is_told_from_a_good_one() -> None:
    nothing, worn = np.zeros(SHAPES), np.zeros(SHAPES)
    worn[:5] = 0.4, -0.1, 0.2, 0.3, 0.1
    assert evidence_of(nothing, 0.3)[0].level == 1.0
    assert evidence_of(0.05 * worn, 0.3)[0].level == 1.0
    assert evidence_of(worn, 0.3)[0].level > 3.0


def test_a_worn_calibration_widens_the_covariance() -> None:
    error = np.zeros(SHAPES)
    error[:5] = 0.4, -0.1, 0.2, 0.3, 0.1
    X, poses = scene(), PoseState()
    local_map = map_of(seen_with(error, X, np.eye(4)))
    covariance, mounted = (
        PoseCovariance(local_map, np.eye(4), CovarianceConfig(), has_body=body, has_depth=True)
        for body in (False, True)
    )
    new_mount = mounted._extrinsic.copy()
    nees = []
    for view in VIEWS * 12:
        T_c_m = se3.exp(view)
        track = tracked(local_map, seen_with(error, X, T_c_m), T_c_m)
        covariance._evaluate(track)
        mounted._evaluate(track)
        T_m_b = se3.inverse(track.T_c_m)
        wrong = T_m_b[:3, 3] - se3.inverse(T_c_m)[:3, 3]
        nees.append(float(wrong @ np.linalg.solve(covariance.of_poses(poses, T_m_b)[0][:3, :3], wrong)))
    assert np.mean(nees[:12]) > 20.0
    assert np.mean(nees[-12:]) < 9.0
    # what wears the lenses wears their mount, too
    assert np.trace(mounted._extrinsic[3:, 3:]) > 20.0 * np.trace(new_mount[3:, 3:])
    np.testing.assert_array_equal(covariance._extrinsic, 0.0)


def test_a_camera_that_is_rotated_in_the_body_widens_the_covariance() -> None:
    """By as much as the rotation that was found: poses do not correct it."""
    T_m_b, poses = se3.exp(np.array([1.0, 2.0, 0.5, 0.4, -0.8, 1.1])), PoseState()
    covariance = PoseCovariance(
        map_of(seen_with(np.zeros(SHAPES), scene(), np.eye(4))), np.eye(4), CovarianceConfig(), has_body=True,
        has_depth=True,
    )  # fmt: skip
    covariance.begin_submap(np.eye(4), np.eye(4))
    before = covariance.of_poses(poses, T_m_b)[0]
    covariance.set_camera_rotation(0.006)
    after = covariance.of_poses(poses, T_m_b)[0]
    rotation = np.array([0.006, 0.0, 0.0])
    wrong = se3.so3_log(T_m_b[:3, :3].T @ se3.so3_exp(-rotation) @ T_m_b[:3, :3] @ se3.so3_exp(rotation))
    assert wrong @ np.linalg.solve(before[3:, 3:], wrong) > 50.0
    assert wrong @ np.linalg.solve(after[3:, 3:], wrong) < 7.8  # 95 % of 3 degrees of freedom

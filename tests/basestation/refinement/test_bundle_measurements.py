"""What a bundle's measurements are worth by octave, calibration and kind; and what moves along with its result."""

from dataclasses import replace

import numpy as np

from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.refinement.apply_bundle import apply_bundle, keep_scales
from kiteline_basestation.refinement.bundle_window import measurements
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_core.optimisation.bundle import BundleResult
from tests.basestation.refinement.test_odometry_factors import CAMERA, CONFIG, IDS, SUBMAP, flight, window


def test_deviations_double_with_each_octave_and_fused_landmarks_and_known_offsets_have_their_own() -> None:
    sparse_map, _ = flight(noise_px=0.1)
    slots = np.arange(40, dtype=np.int32)
    octave = (slots % 3).astype(np.uint8)
    sparse_map.keypoints.octave[slots] = octave
    _, sigma = measurements(sparse_map, slots, CONFIG.measurement)
    scale = 2.0**octave
    np.testing.assert_allclose(sigma, np.column_stack([0.25 * scale, 0.2 * scale]))
    sparse_map.disparity_calibrated.add(AgentId(0))
    births = np.flatnonzero(sparse_map.keypoints.root[slots] == slots)[4:7]
    sparse_map.keypoints.root[births] = births[0] - 1
    _, sigma = measurements(sparse_map, slots, CONFIG.measurement)
    pixel = 0.25 * scale
    pixel[births] = 0.6 * scale[births]
    np.testing.assert_allclose(sigma, np.column_stack([pixel, 0.1 * scale]))


def test_a_culled_keyframe_moves_as_its_ancestor_does() -> None:
    sparse_map, _ = flight(noise_px=0.1, births=40, turn_rad=0.2)
    culled, motion = IDS[5], se3.exp(np.array([0.05, -0.02, 0.04, 0.02, -0.03, 0.05]))
    sparse_map.set_world_pose(culled, sparse_map.world_pose(culled))  # only keyframes that a bundle placed are culled
    sparse_map.cull_keyframe(culled)
    part, before = window(sparse_map, IDS[:5]), sparse_map.world_pose(culled)
    assert before is not None and sparse_map.rows[culled] not in part.rows.tolist()
    problem = part.problem
    poses = np.where(problem.free[:, None, None], problem.T_c_m @ se3.inverse(motion), problem.T_c_m)
    points = se3.transform(motion, problem.points)
    result = BundleResult(poses, points, np.ones(len(problem.camera), np.bool_), 0.0, 0.0, 1, 1)
    apply_bundle(sparse_map, part, result, Publisher(sparse_map, CONFIG.publish), CONFIG.publish)
    np.testing.assert_allclose(sparse_map.world_pose(culled), motion @ before, atol=1e-9)


def test_a_bundle_that_scales_a_whole_map_without_metres_leaves_its_lengths() -> None:
    """The oldest keyframes keep theirs: poses, points and the unit of the submap are divided by what they grew by."""
    sparse_map, _ = flight(noise_px=0.0, births=40, turn_rad=0.1)
    sparse_map.set_camera(AgentId(0), replace(CAMERA, stereo=False))
    sparse_map.measures_depth.clear()
    part, growth = window(sparse_map), 1.25
    T_w_c = np.linalg.inv(part.problem.T_c_m)
    T_w_c[:, :3, 3] *= growth  # about the first keyframe, which is at the origin
    inlier = np.ones(len(part.problem.camera), np.bool_)
    grown = BundleResult(np.linalg.inv(T_w_c), growth * part.problem.points, inlier, 0.0, 0.0, 1, 1)
    result, factors = keep_scales(sparse_map, SUBMAP, part, grown)
    np.testing.assert_allclose(result.T_c_m, part.problem.T_c_m, atol=1e-5)
    np.testing.assert_allclose(result.points, part.problem.points, atol=1e-4)
    np.testing.assert_allclose(factors[SUBMAP], 1.0, atol=1e-5)

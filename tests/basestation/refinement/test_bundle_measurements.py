"""What a bundle's measurements are worth by octave, calibration and kind; and what moves along with its result."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.map_tables import REFINED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.apply_bundle import apply_bundle, keep_scales
from kiteline_basestation.refinement.bundle_window import BundleWindow, measurements
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id
from kiteline_core.optimisation.bundle import BundleResult
from tests.basestation.refinement.test_odometry_factors import CAMERA, CONFIG, IDS, SUBMAP, flight, window
from tests.basestation.refinement.test_steps_between_views import flight_of_one_camera


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


def scaled_about_the_first(part: BundleWindow, growth: float) -> BundleResult:
    """What a bundle finds of a window that it makes larger; the first keyframe is at the origin."""
    T_w_c = np.linalg.inv(part.problem.T_c_m)
    T_w_c[:, :3, 3] *= growth
    inlier = np.ones(len(part.problem.camera), np.bool_)
    return BundleResult(np.linalg.inv(T_w_c), growth * part.problem.points, inlier, 0.0, 0.0, 1, 1)


def test_a_bundle_that_scales_a_whole_map_without_metres_leaves_its_lengths() -> None:
    """The oldest keyframes keep theirs: poses, points and the unit of the submap are divided by what they grew by."""
    sparse_map = flight_of_one_camera(births=40, turn_rad=0.1)
    part = window(sparse_map)
    result, factors = keep_scales(sparse_map, SUBMAP, part, scaled_about_the_first(part, 1.25))
    np.testing.assert_allclose(result.T_c_m, part.problem.T_c_m, atol=1e-5)
    np.testing.assert_allclose(result.points, part.problem.points, atol=1e-4)
    np.testing.assert_allclose(factors[SUBMAP], 1.0, atol=1e-5)


def test_a_map_without_metres_does_not_grow_with_the_bundles_of_it() -> None:
    """What a bundle leaves as it was, since it changes by less than is sent, is in the unit of before."""
    sparse_map = flight_of_one_camera(births=40, turn_rad=0.1)
    publisher = Publisher(sparse_map, CONFIG.publish)
    sparse_map.scale_submap(SUBMAP, 1.004)  # as it was in truth, landmarks and all
    for _ in range(20):
        part = window(sparse_map)
        result, _ = keep_scales(sparse_map, SUBMAP, part, scaled_about_the_first(part, 0.98))
        apply_bundle(sparse_map, part, result, publisher, CONFIG.publish)
    lengths = np.linalg.norm(np.diff([sparse_map.world_pose(k)[:3, 3] for k in IDS], axis=0), axis=1)  # type: ignore[index]
    np.testing.assert_allclose(lengths, 0.15, rtol=1e-3)
    assert abs(sparse_map.scale(SUBMAP) - 1.0) < 1e-6


@pytest.mark.parametrize("units", [1.0, 40.0])
def test_depths_in_a_unit_of_its_own_are_told_alike_in_any_unit(units: float) -> None:
    sparse_map = flight_of_one_camera(births=40, turn_rad=0.1)
    sparse_map.keyframes.T_p_k[:, :3, 3] *= units
    table = sparse_map.keypoints
    table.inv_depth[table.inv_depth > 0.0] /= units
    for row in map(int, [sparse_map.rows[k] for k in IDS]):
        T_w_k = sim3.with_scaled_translation(sparse_map.keyframes.T_w_k[row], units)
        sparse_map.set_world_pose(KeyframeId(int(sparse_map.keyframes.id[row])), T_w_k, carry=False)
    part, publisher = window(sparse_map), Publisher(sparse_map, CONFIG.publish)
    points = part.problem.points.copy()
    points[::2] *= 1.05  # 5 % farther from the first keyframe, where most of them began
    inlier = np.ones(len(part.problem.camera), np.bool_)
    apply_bundle(
        sparse_map, part, BundleResult(part.problem.T_c_m, points, inlier, 0.0, 0.0, 1, 1), publisher, CONFIG.publish
    )
    told = table.flags[part.points] & REFINED != 0
    assert told[::2].mean() > 0.9
    assert not told[1::2].any()


def test_a_unit_that_drifted_is_that_of_the_newest_keyframes() -> None:
    """As the world keeps the lengths of the oldest, nothing changes for the agent where it flies."""
    sparse_map, n = SparseMap(), 60
    sparse_map.set_camera(AgentId(0), replace(CAMERA, stereo=False))
    for k in range(n):
        step = se3.from_rt(np.eye(3), [0.5 if k < n // 2 else 0.4, 0.0, 0.0])
        parent = keyframe_id(SUBMAP, k - 1) if k else NO_KEYFRAME
        sparse_map.add_keyframe(keyframe_id(SUBMAP, k), k, parent, step if k else np.eye(4), 0)
    rows = np.array([sparse_map.rows[keyframe_id(SUBMAP, k)] for k in range(n)], np.int32)
    T_w_k = np.tile(np.eye(4), (n, 1, 1))
    T_w_k[:, 0, 3] = 0.7 * np.arange(n)  # a bundle found all steps equally long
    T_w_k[5, 0, 3] += 0.3  # but for two that are torn
    empty = BundleWindow(rows, *(np.zeros(0, np.int32),) * 2, window(flight(0.1)[0]).problem)
    found = BundleResult(np.linalg.inv(T_w_k), np.zeros((0, 3)), np.zeros(0, np.bool_), 0.0, 0.0, 1, 1)
    result, factors = keep_scales(sparse_map, SUBMAP, empty, found)
    np.testing.assert_allclose(np.linalg.inv(result.T_c_m)[-1, 0, 3], 0.5 * (n - 1), rtol=1e-9)
    assert factors[SUBMAP] == sparse_map.scale(SUBMAP) == pytest.approx(0.5 / 0.4)

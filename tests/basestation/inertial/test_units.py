"""The length in w of an agent's unit: of a whole submap, or as long as the steps around have it in the map."""

from dataclasses import replace

import numpy as np

from kiteline_basestation.inertial.units import units_of
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id
from tests.basestation.refinement.test_odometry_factors import CAMERA, SUBMAP


def test_a_map_with_another_unit_that_no_accelerations_corrected_is_held_to_it() -> None:
    sparse_map, step = SparseMap(), se3.from_rt(np.eye(3), [0.5, 0.0, 0.0])
    sparse_map.set_camera(AgentId(0), replace(CAMERA, stereo=False))
    sparse_map.metric_submaps.add(SUBMAP)
    keyframes = [keyframe_id(SUBMAP, k) for k in range(12)]
    for k, keyframe in enumerate(keyframes):
        sparse_map.add_keyframe(keyframe, k, keyframes[k - 1] if k else NO_KEYFRAME, step if k else np.eye(4), 0)
    sparse_map.scale_submap(SUBMAP, 0.98)  # a tie to a later submap told the metre
    rows = np.array([sparse_map.rows[k] for k in keyframes], np.int32)
    sparse_map.keyframes.T_w_k[rows, 0, 3] *= 1.03  # bundles stretched it
    assert np.array_equal(units_of(sparse_map, rows, 20), np.full(12, 0.98))


def test_where_accelerations_have_corrected_lengths_steps_are_as_long_as_the_map_has_them_now() -> None:
    sparse_map, n, step = SparseMap(), 60, se3.from_rt(np.eye(3), [0.5, 0.0, 0.0])
    sparse_map.set_camera(AgentId(0), replace(CAMERA, stereo=False))
    sparse_map.metric_submaps.add(SUBMAP)
    for k in range(n):
        parent = keyframe_id(SUBMAP, k - 1) if k else NO_KEYFRAME
        sparse_map.add_keyframe(keyframe_id(SUBMAP, k), k, parent, step if k else np.eye(4), 0)  # of equal weight
    rows = np.array([sparse_map.rows[keyframe_id(SUBMAP, k)] for k in range(n)], np.int32)
    assert np.array_equal(units_of(sparse_map, rows, 20), np.ones(n))
    sparse_map.scaled_submaps.add(SUBMAP)
    grown = np.where(np.arange(n) < n // 2, 1.0, 0.95)  # the newest keyframes have another length
    grown[10] = 40.0  # and one step is torn
    sparse_map.keyframes.T_w_k[rows, 0, 3] = np.cumsum(np.r_[0.0, 0.5 * grown[1:]])
    found = units_of(sparse_map, rows, 20)
    assert np.allclose(found[1:20], 1.0) and np.allclose(found[40:], 0.95)
    sparse_map.keyframes.T_w_k[rows, 0, 3] *= 3.0
    assert units_of(sparse_map, rows, 20).max() < 1.11  # a map that is torn as a whole is not held


def test_steps_in_a_map_without_a_unit_are_as_long_as_those_around() -> None:
    """Units of agents drift: that of the newest steps is 1.3 times the first, and the map has them as they are."""
    sparse_map, n = SparseMap(), 60
    sparse_map.set_camera(AgentId(0), replace(CAMERA, stereo=False))
    for k in range(n):
        step = se3.from_rt(np.eye(3), [0.5 * 1.3 ** (-k / n), 0.0, 0.0])
        parent = keyframe_id(SUBMAP, k - 1) if k else NO_KEYFRAME
        sparse_map.add_keyframe(keyframe_id(SUBMAP, k), k, parent, step if k else np.eye(4), 0)
    rows = np.array([sparse_map.rows[keyframe_id(SUBMAP, k)] for k in range(n)], np.int32)
    sparse_map.keyframes.T_w_k[rows, 0, 3] = 0.5 * np.arange(n)
    assert np.allclose(units_of(sparse_map, rows, 20)[10:-10], 1.3 ** (np.arange(10, n - 10) / n), rtol=0.01)


def test_steps_over_keyframes_that_a_window_leaves_out_tell_no_unit() -> None:
    """A window of old and new keyframes: the way between them is the agent's drift, and longer than all steps."""
    sparse_map, n = SparseMap(), 60
    sparse_map.set_camera(AgentId(0), replace(CAMERA, stereo=False))
    for k in range(n):
        parent = keyframe_id(SUBMAP, k - 1) if k else NO_KEYFRAME
        sparse_map.add_keyframe(keyframe_id(SUBMAP, k), k, parent, se3.from_rt(np.eye(3), [0.5, 0.0, 0.0]), 0)
    rows = np.array([sparse_map.rows[keyframe_id(SUBMAP, k)] for k in (*range(8), *range(50, n))], np.int32)
    sparse_map.keyframes.T_w_k[rows, 0, 3] = 0.65 * np.r_[np.arange(8), np.arange(10) + 10.0]  # the way is much shorter
    assert np.allclose(np.delete(units_of(sparse_map, rows, 20), (0, 8)), 1.3)  # those after their parents
    sparse_map.cull_keyframe(keyframe_id(SUBMAP, 54))
    rows = rows[rows != sparse_map.rows[keyframe_id(SUBMAP, 54)]]
    assert np.allclose(np.delete(units_of(sparse_map, rows, 20), (0, 8)), 1.3)  # the step over it counts

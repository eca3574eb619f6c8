"""What rests on a merge, what was fused over its border, and how changes of one step add up."""

import numpy as np

from kiteline_basestation.merging.loop_edges import LoopEdge
from kiteline_basestation.merging.merges import MapMerge, MergeResult, edges_out_of, fused_across, resting_on
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, keyframe_id, point_id, submap_id
from tests.basestation.map.test_sparse_map import SUBMAP, chain, kf

A, B, C, D = (SubmapId(submap_id(agent, 1, 0)) for agent in range(4))
E: F64 = np.eye(4)


def edge(new: SubmapId, old: SubmapId) -> LoopEdge:
    return LoopEdge(keyframe_id(new, 3), keyframe_id(old, 2), E, 40, 3.0)


def test_edges_out_of_submaps_name_the_one_inside_first() -> None:
    edges = [edge(A, B), edge(C, A), edge(A, D), edge(B, C), edge(C, D)]
    assert edges_out_of({A, D}, edges) == [(A, B), (A, C), (D, C)]


def test_a_later_merge_rests_on_one_if_all_its_edges_lead_there() -> None:
    merge, later = MapMerge(B, A, {B: E}), MapMerge(C, A, {C: E})
    assert resting_on(merge, [later], [edge(C, B), edge(B, A)]) is later
    assert resting_on(merge, [later], [edge(B, C), edge(B, A)]) is later
    assert resting_on(merge, [later], [edge(C, B), edge(C, A)]) is None  # A holds it as well
    assert resting_on(merge, [later], [edge(B, A)]) is None  # a user merged it
    holder = MapMerge(A, C, {A: E, B: E})  # the map of both was merged into a third one, by the wrong submap alone
    assert resting_on(merge, [holder], [edge(C, B), edge(B, A)]) is holder
    assert resting_on(merge, [MapMerge(D, A, {D: E}), later], [edge(C, B), edge(D, A)]) is later


def test_landmarks_are_fused_across_where_root_and_landmark_are_on_two_sides() -> None:
    """Observations are none: they follow the landmark that they name."""
    sparse_map, other = chain(3), submap_id(4, 1, 0)
    sparse_map.set_camera(AgentId(4), RectifiedCamera(640, 480, 400.0, 410.0, 320.0, 240.0, 0.1, True, E))
    keyframe = keyframe_id(other, 0)
    sparse_map.add_keyframe(keyframe, 0, KeyframeId(-1), se3.exp(np.zeros(6)), 6)
    descriptor = np.zeros((6, 32), np.uint8)
    sparse_map.put_new_landmarks(
        keyframe, 0, np.arange(6, dtype=np.uint16), np.full((6, 2), 100, np.float32), np.full(6, 0.25, np.float32),
        np.zeros(6, np.uint8), np.zeros(6, np.uint8), descriptor,
    )  # fmt: skip
    later = keyframe_id(other, 1)
    sparse_map.add_keyframe(later, 1, keyframe, np.eye(4), 1)
    sparse_map.put_observations(
        later, 0, np.zeros(1, np.uint16), np.full((1, 2), 100, np.float32), np.zeros(1, np.float32),
        np.zeros(1, np.uint8), np.array([point_id(keyframe, 1)], np.int64),
    )  # fmt: skip
    mine, theirs = sparse_map.slots_of(kf(0)), sparse_map.slots_of(keyframe)
    sparse_map.fuse(int(theirs[1]), int(mine[1]))  # observed by both
    sparse_map.fuse(int(mine[5]), int(theirs[2]))
    sparse_map.fuse(int(sparse_map.slots_of(kf(2))[5]), int(mine[4]))  # on one side
    expected = sorted([int(theirs[1]), int(mine[5])])
    assert fused_across(sparse_map, {other}).tolist() == fused_across(sparse_map, {SUBMAP}).tolist() == expected
    assert fused_across(sparse_map, {other, SUBMAP}).tolist() == []


def test_changes_of_one_step_add_up() -> None:
    k = keyframe_id(A, 1)
    first = MergeResult(frozenset({A}), {A: 2.0, B: 3.0}, {A: 0.1, B: 0.2}, frozenset({A}), (k,), frozenset({1}))
    later = MergeResult(
        frozenset({B}), {A: 1.5, C: 0.5}, {B: 0.3}, frozenset({B}), (KeyframeId(k + 1),), frozenset({2})
    )
    total = first + later
    assert total == MergeResult(
        frozenset({A, B}), {A: 3.0, B: 3.0, C: 0.5}, {A: 0.1, B: 0.3}, frozenset({A, B}), (k, KeyframeId(k + 1)),
        frozenset({1, 2}),
    )  # fmt: skip

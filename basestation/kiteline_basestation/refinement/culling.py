"""Drops points that later keyframes should have seen and did not, and keyframes that tell nothing new (ORB-SLAM2)."""

from __future__ import annotations

import numpy as np

from kiteline_basestation.config import CullConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.map_tables import CULLED, LANDMARK, REFINED_POSE
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.apply_bundle import cull_landmarks
from kiteline_basestation.refinement.landmark_matching import predict_projections
from kiteline_codec.schema import CulledLandmarks
from kiteline_core.ids import KeyframeId, submap_of_keyframe


def cull_weak(sparse_map: SparseMap, keyframe: KeyframeId, config: CullConfig, publisher: Publisher) -> int:
    """Judge the points born `age` keyframes before this one. Returns how many were dropped."""
    same = sparse_map.submaps[submap_of_keyframe(keyframe)]
    number = same.index(keyframe)
    if number < config.landmark_age:
        return 0
    judged = same[number - config.landmark_age]
    table = sparse_map.keypoints
    slots = sparse_map.slots_of(judged)
    own = (table.kind[slots] == LANDMARK) & (table.root[slots] == slots) & (table.flags[slots] & CULLED == 0)
    points = slots[own]
    visible = np.zeros(sparse_map.slots, np.int32)
    for later in same[number - config.landmark_age + 1 : number + 1]:
        if sparse_map.pose(later) is not None:
            visible[predict_projections(sparse_map, points, later)[0]] += 1
    found = np.diff(sparse_map.observations(points)[0]) - 1
    weak = (visible[points] >= config.min_visible) & (found < config.min_found * visible[points])
    cull_landmarks(sparse_map, points[weak], publisher)
    return int(np.count_nonzero(weak))


def cull_redundant(
    sparse_map: SparseMap, keyframe: KeyframeId, config: CullConfig, publisher: Publisher
) -> list[KeyframeId]:
    """Judge the keyframes around this one: nearly all that they see, others see as well. Returns those dropped."""
    out: list[KeyframeId] = []
    for other in sparse_map.covisible_keyframes(keyframe, 15):
        same = sparse_map.submaps[submap_of_keyframe(other)]
        at = same.index(other)
        if at == 0 or len(same) - at <= config.keyframe_age or not sparse_map.is_complete(other):
            continue
        if sparse_map.keyframes.pose_source[sparse_map.rows[other]] == REFINED_POSE and _redundant(
            sparse_map, other, config
        ):
            sparse_map.cull_keyframe(other)
            publisher.mark_changed(CulledLandmarks.KIND, other)
            out.append(other)
    return out


def _redundant(sparse_map: SparseMap, keyframe: KeyframeId, config: CullConfig) -> bool:
    table, row = sparse_map.keypoints, sparse_map.rows[keyframe]
    mine = sparse_map.observations_of(keyframe)
    points = table.root[mine]
    starts, slots = sparse_map.observations(points)
    which = np.repeat(np.arange(len(points)), np.diff(starts))
    finer = table.octave[slots].astype(np.int64) <= table.octave[mine[which]].astype(np.int64) + 1
    others = np.bincount(which[finer & (table.row[slots] != row)], minlength=len(points))
    return len(points) > 0 and float(np.mean(others >= config.keyframe_others)) >= config.keyframe_share

"""Drops points that later keyframes should have seen and did not ("found" ratio of ORB-SLAM2)."""

from __future__ import annotations

import numpy as np

from kiteline_basestation.config import CullConfig
from kiteline_basestation.publisher import Publisher
from kiteline_basestation.refind import foresee
from kiteline_basestation.refinement import drop_points
from kiteline_core.ids import KeyframeId, submap_of_keyframe
from kiteline_core.map_tables import BIRTH, CULLED
from kiteline_core.sparse_map import SparseMap


def cull_weak(sparse_map: SparseMap, keyframe: KeyframeId, config: CullConfig, publisher: Publisher) -> int:
    """Judge the points born `age` keyframes before this one. Returns how many were dropped."""
    same = sparse_map.submaps[submap_of_keyframe(keyframe)]
    number = same.index(keyframe)
    if number < config.age:
        return 0
    judged = same[number - config.age]
    table = sparse_map.keypoints
    slots = sparse_map.slots_of(judged)
    own = (table.kind[slots] == BIRTH) & (table.root[slots] == slots) & (table.flags[slots] & CULLED == 0)
    points = slots[own]
    visible = np.zeros(sparse_map.slots, np.int32)
    for later in same[number - config.age + 1 : number + 1]:
        if sparse_map.pose(later) is not None:
            visible[foresee(sparse_map, points, later)[0]] += 1
    found = np.diff(sparse_map.observations(points)[0]) - 1
    weak = (visible[points] >= config.min_visible) & (found < config.min_found * visible[points])
    drop_points(sparse_map, points[weak], publisher)
    return int(np.count_nonzero(weak))

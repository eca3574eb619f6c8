"""Moves whole maps: what a pose graph or a full bundle found goes into the map, and what came meanwhile moves along."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import GraphConfig, PublishConfig
from kiteline_basestation.covisibility import covisible_keyframes
from kiteline_basestation.essential_graph import GraphInputs
from kiteline_basestation.overlap import Overlap
from kiteline_basestation.publisher import Publisher
from kiteline_codec.schema import Kind
from kiteline_core import se3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId
from kiteline_core.sparse_map import SparseMap

F64 = NDArray[np.float64]


def keyframes_of(sparse_map: SparseMap, island: SubmapId) -> list[KeyframeId]:
    """All keyframes of a map that have a pose, in order of id."""
    keyframes = [k for s in sparse_map.island(island) for k in sparse_map.submaps.get(s, [])]
    return [k for k in keyframes if sparse_map.pose(k) is not None]


def graph_of(
    sparse_map: SparseMap, island: SubmapId, loops: tuple[Overlap, ...], config: GraphConfig
) -> GraphInputs | None:  # fmt: skip
    """The essential graph of a map. Its eldest submap's first keyframe holds it in place."""
    keyframes = keyframes_of(sparse_map, island)
    if len(keyframes) < 2:
        return None
    number = {k: i for i, k in enumerate(keyframes)}
    poses = np.stack([sparse_map.keyframes.T_w_k[sparse_map.rows[k]] for k in keyframes])
    pairs: set[tuple[int, int]] = set()
    for keyframe in keyframes:
        parent = KeyframeId(int(sparse_map.keyframes.parent[sparse_map.rows[keyframe]]))
        if parent in number:
            pairs.add((number[parent], number[keyframe]))
        for other in covisible_keyframes(sparse_map, keyframe, config.min_shared):
            if other < keyframe and other in number:
                pairs.add((number[other], number[keyframe]))
    edges = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    between = np.linalg.inv(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    length = np.linalg.norm(between[:, :3, 3], axis=1)
    sigma = np.column_stack([config.sigma_m + config.sigma_path * length, np.full(len(edges), config.sigma_rad)])
    inside = [v for v in loops if v.old in number and v.new in number]
    far = np.array([[number[v.old], number[v.new]] for v in inside], np.int64).reshape(-1, 2)
    measured = np.array([v.T_old_new for v in inside]).reshape(-1, 4, 4)
    doubt = np.array(
        [[config.sigma_m + config.loop_sigma_depth * v.depth_m, config.loop_sigma_rad] for v in inside]
    ).reshape(-1, 2)  # fmt: skip
    held = np.zeros(len(keyframes), np.bool_)
    held[number[KeyframeId(sparse_map.submaps[sparse_map.island_of(island)][0])]] = True
    return GraphInputs(
        np.array(keyframes, np.int64), poses, held, np.concatenate([edges, far]), np.concatenate([between, measured]),
        np.concatenate([np.round(sigma, 4), np.round(doubt, 4)]),
        np.concatenate([np.zeros(len(edges), np.bool_), np.ones(len(far), np.bool_)]), config,
    )  # fmt: skip


def move_keyframes(
    sparse_map: SparseMap, island: SubmapId, targets: Mapping[KeyframeId, F64], publisher: Publisher,
    publish: PublishConfig,
) -> float:  # fmt: skip
    """Bring keyframes to T_w_k (4,4); those that came after the work began follow the nearest one before them.

    A submap's first keyframe stays in its own m: the submap moves instead. Returns the largest motion in m.
    """
    keyframes = keyframes_of(sparse_map, island)
    goal: dict[KeyframeId, F64] = {}
    largest = 0.0
    for keyframe in keyframes:  # in order of id: parents first
        old = sparse_map.world_pose(keyframe)
        assert old is not None
        if keyframe in targets:
            goal[keyframe] = targets[keyframe]
        else:
            parent = KeyframeId(int(sparse_map.keyframes.parent[sparse_map.rows[keyframe]]))
            above = sparse_map.world_pose(parent) if parent != NO_KEYFRAME else None
            if above is None or parent not in goal:
                goal[keyframe] = old
            else:
                goal[keyframe] = se3.orthonormalise(goal[parent] @ se3.inverse(above) @ old)
        largest = max(largest, float(np.linalg.norm(goal[keyframe][:3, 3] - old[:3, 3])))
    for submap in sparse_map.island(island):
        first = sparse_map.submaps[submap][0]
        T_m_k = sparse_map.pose(first)
        if T_m_k is not None and submap != sparse_map.island_of(island):
            sparse_map.move_submap(submap, se3.orthonormalise(goal[first] @ se3.inverse(T_m_k)))
    firsts = {sparse_map.submaps[s][0] for s in sparse_map.island(island)}
    for keyframe in keyframes:
        if keyframe in firsts:
            continue
        now = sparse_map.world_pose(keyframe)
        assert now is not None
        change = se3.inverse(now) @ goal[keyframe]
        moved = float(np.linalg.norm(change[:3, 3]))
        turned = float(np.linalg.norm(change[:3, :3] - np.eye(3))) / np.sqrt(2.0)
        if moved > publish.pose_m or turned > publish.pose_rad:
            sparse_map.set_world_pose(keyframe, goal[keyframe])
            publisher.touch(Kind.POSE, keyframe)
    return largest

"""Moves whole maps: what a pose graph or a full bundle found goes into the map, and what came meanwhile moves along."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import BaseConfig, GraphConfig, PublishConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.map_tables import LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.essential_graph import GraphInputs, Scaled
from kiteline_basestation.merging.loop_edges import depth_of, edge_of
from kiteline_basestation.merging.loop_verification import LoopMatch
from kiteline_basestation.refinement.bundle_window import BundleWindow, bundle_window
from kiteline_codec.schema import KeyframePose, RefinedLandmarks
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId, submap_of_keyframe

F64 = NDArray[np.float64]

_SAME = 1e-4  # relative: what lengths may grow by before it is worth saying, a fifth of an inverse depth's code


def keyframes_of(sparse_map: SparseMap, map_id: SubmapId) -> list[KeyframeId]:
    """All keyframes of a map that have a pose, in order of id."""
    keyframes = [k for s in sparse_map.submaps_of_map(map_id) for k in sparse_map.submaps.get(s, [])]
    return [k for k in keyframes if sparse_map.pose(k) is not None]


def graph_of(
    sparse_map: SparseMap, map_id: SubmapId, loops: tuple[LoopMatch, ...], config: GraphConfig
) -> GraphInputs | None:  # fmt: skip
    """The essential graph of a map. Its eldest submap's first keyframe holds it in place."""
    keyframes = keyframes_of(sparse_map, map_id)
    if len(keyframes) < 2:
        return None
    number = {k: i for i, k in enumerate(keyframes)}
    poses = np.stack([sparse_map.keyframes.T_w_k[sparse_map.rows[k]] for k in keyframes])
    pairs: set[tuple[int, int]] = set()
    for keyframe in keyframes:
        parent = KeyframeId(int(sparse_map.keyframes.parent[sparse_map.rows[keyframe]]))
        if parent in number:
            pairs.add((number[parent], number[keyframe]))
        for other in sparse_map.covisible_keyframes(keyframe, config.min_shared):
            if other < keyframe and other in number:
                pairs.add((number[other], number[keyframe]))
    edges = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    between = np.linalg.inv(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    length = np.linalg.norm(between[:, :3, 3], axis=1)
    sigma = np.column_stack([config.sigma_m + config.sigma_path * length, np.full(len(edges), config.sigma_rad)])
    inside = [v for v in loops if v.old in number and v.new in number]
    edged = [edge_of(sparse_map, v) for v in inside]
    far = np.array([[number[v.old], number[v.new]] for v in inside], np.int64).reshape(-1, 2)
    measured = np.array([T for T, _ in edged]).reshape(-1, 4, 4)
    doubt = np.array(
        [[config.sigma_m + config.loop_sigma_depth * depth_of(sparse_map, v), config.loop_sigma_rad] for v in inside]
    ).reshape(-1, 2)  # fmt: skip
    held = np.zeros(len(keyframes), np.bool_)
    held[number[KeyframeId(sparse_map.submaps[sparse_map.map_id(map_id)][0])]] = True
    own = {s for s in sparse_map.submaps_of_map(map_id) if sparse_map.is_up_to_scale(s)}
    scaled = None
    if own:
        free = np.array([submap_of_keyframe(k) in own for k in keyframes])
        scaled = Scaled(
            free, np.concatenate([np.ones(len(edges)), [scale for _, scale in edged]]),
            np.repeat([config.sigma_scale, config.loop_sigma_scale], [len(edges), len(far)]),
        )  # fmt: skip
    return GraphInputs(
        np.array(keyframes, np.int64), poses, held, np.concatenate([edges, far]), np.concatenate([between, measured]),
        np.concatenate([np.round(sigma, 4), np.round(doubt, 4)]),
        np.concatenate([np.zeros(len(edges), np.bool_), np.ones(len(far), np.bool_)]), config, scaled,
    )  # fmt: skip


def move_keyframes(
    sparse_map: SparseMap, map_id: SubmapId, targets: Mapping[KeyframeId, F64], publisher: Publisher,
    publish: PublishConfig,
) -> float:  # fmt: skip
    """Bring keyframes to T_w_k (4,4); those that came after the work began follow the nearest one before them.

    A submap's first keyframe stays in its own m: the submap moves instead. Returns the largest motion in m.
    """
    keyframes = keyframes_of(sparse_map, map_id)
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
    for submap in sparse_map.submaps_of_map(map_id):
        first = sparse_map.submaps[submap][0]
        T_m_k = sparse_map.pose(first)
        stays = submap == sparse_map.map_id(map_id) and not sparse_map.is_up_to_scale(submap)
        if T_m_k is not None and not stays:
            unit = sparse_map.scale(submap)
            sparse_map.move_submap(submap, sim3.normalise(sim3.of(unit, goal[first]) @ se3.inverse(T_m_k)))
    firsts = {sparse_map.submaps[s][0] for s in sparse_map.submaps_of_map(map_id)}
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
            publisher.mark_changed(KeyframePose.KIND, keyframe)
    return largest


def rescale(
    sparse_map: SparseMap, map_id: SubmapId, growth: Mapping[KeyframeId, float], publisher: Publisher
) -> tuple[dict[SubmapId, float], dict[KeyframeId, float]]:  # fmt: skip
    """Lengths before keyframes grow in w by `growth`; where one eye flew, its submap's unit grows as they do before the
    newest keyframe, so that nothing changes where the agent is. Points hang on their keyframes: those of older ones
    take on the rest. Where the keyframes lie is for `move_keyframes`. Returns by what units grew, and lengths in the
    submaps.
    """
    units: dict[SubmapId, float] = {}
    left: dict[KeyframeId, float] = {}
    for submap in sparse_map.submaps_of_map(map_id):
        if not sparse_map.is_up_to_scale(submap):
            continue
        known = [k for k in sparse_map.submaps[submap] if k in growth]
        if not known:
            continue
        newest = units[submap] = growth[known[-1]]
        sparse_map.scale_submap(submap, newest)
        for keyframe in known:
            more = growth[keyframe] / newest
            if abs(more - 1.0) > _SAME:
                left[keyframe] = more
                _grow(sparse_map, keyframe, more, publisher)
    return units, left


def _grow(sparse_map: SparseMap, keyframe: KeyframeId, factor: float, publisher: Publisher) -> None:
    """The points born in a keyframe lie so many times as far away."""
    table, slots = sparse_map.keypoints, sparse_map.slots_of(keyframe)
    offset = table.offset[slots]
    inverse = sparse_map.inverse_depths(slots)
    known = (table.kind[slots] == LANDMARK) & (inverse > 0.0)
    if known.any():
        sparse_map.set_depths(slots[known], (inverse[known] / factor).astype(np.float32), offset[known])
        publisher.mark_changed(RefinedLandmarks.KIND, keyframe)


def whole_window(
    sparse_map: SparseMap, map_id: SubmapId, loops: Sequence[LoopMatch], base: BaseConfig
) -> BundleWindow | None:  # fmt: skip
    """The problem of a whole map, or of the part around its newest loop when it is too large."""
    config = base.graph
    keyframes = [k for k in keyframes_of(sparse_map, map_id) if not sparse_map.keyframes.culled[sparse_map.rows[k]]]
    first = sparse_map.submaps[sparse_map.map_id(map_id)][0]
    if len(keyframes) > config.max_full:
        newest = next((v for v in reversed(loops) if v.new in keyframes), None)
        spots = [newest.new, newest.old] if newest is not None else keyframes[-1:]
        near = sparse_map.keyframes.T_w_k[[sparse_map.rows[k] for k in keyframes], :3, 3]
        centres = np.stack([sparse_map.keyframes.T_w_k[sparse_map.rows[k], :3, 3] for k in spots])
        distance = np.linalg.norm(near[:, None] - centres, axis=2).min(axis=1)
        keep = np.sort(np.argsort(distance, kind="stable")[: config.max_full])
        keyframes = [keyframes[i] for i in keep.tolist()]
    if len(keyframes) < 2:
        return None
    wide = replace(base.window, fixed=config.max_full // 2)
    return bundle_window(sparse_map, keyframes, wide, base.measurement, {first})

"""Corrections of whole maps: pose graphs and full bundle windows, and how keyframes take on their results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import BaseConfig, GraphConfig, PublishConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.inertial.level import level_of
from kiteline_basestation.map.map_tables import LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.essential_graph import GraphInputs, Scaled
from kiteline_basestation.merging.loop_edges import LoopEdge, depth_of, graph_edge_of
from kiteline_basestation.refinement.bundle_window import BundleWindow, bundle_window
from kiteline_codec.schema import KeyframePose, RefinedLandmarks
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId, submap_of_keyframe

F64 = NDArray[np.float64]

_SAME = 1e-4  # relative change of depths that is not sent: a fifth of the code of an inverse depth


def keyframes_of(sparse_map: SparseMap, map_id: SubmapId) -> list[KeyframeId]:
    """All keyframes of a map that have a pose, in order of id."""
    keyframes = [k for s in sparse_map.submaps_of_map(map_id) for k in sparse_map.submaps.get(s, [])]
    return [k for k in keyframes if sparse_map.pose(k) is not None]


def essential_graph_of(
    sparse_map: SparseMap, map_id: SubmapId, loops: Sequence[LoopEdge], config: GraphConfig
) -> GraphInputs | None:  # fmt: skip
    """The essential graph of a map, fixed at the first keyframe of its root submap; None with fewer than two."""
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
    inside = [e for e in loops if e.old in number and e.new in number]
    loop_edges = [graph_edge_of(sparse_map, e) for e in inside]
    loop_pairs = np.array([[number[e.old], number[e.new]] for e in inside], np.int64).reshape(-1, 2)
    measured = np.array([T for T, _ in loop_edges]).reshape(-1, 4, 4)
    loop_sigma = np.array(
        [[config.sigma_m + config.loop_sigma_depth * depth_of(sparse_map, e), config.loop_sigma_rad] for e in inside]
    ).reshape(-1, 2)  # fmt: skip
    held = np.zeros(len(keyframes), np.bool_)
    held[number[KeyframeId(sparse_map.submaps[sparse_map.map_id(map_id)][0])]] = True
    own = {s for s in sparse_map.submaps_of_map(map_id) if sparse_map.is_up_to_scale(s)}
    scaled = None
    if own:
        free = np.array([submap_of_keyframe(k) in own for k in keyframes])
        scaled = Scaled(
            free, np.concatenate([np.ones(len(edges)), [scale for _, scale in loop_edges]]),
            np.repeat([config.sigma_scale, config.loop_sigma_scale], [len(edges), len(loop_pairs)]),
        )  # fmt: skip
    return GraphInputs(
        np.array(keyframes, np.int64), poses, held, np.concatenate([edges, loop_pairs]),
        np.concatenate([between, measured]), np.concatenate([np.round(sigma, 4), np.round(loop_sigma, 4)]),
        np.concatenate([np.zeros(len(edges), np.bool_), np.ones(len(loop_pairs), np.bool_)]), config, scaled,
        level_of(sparse_map, keyframes),
    )  # fmt: skip


def move_keyframes(
    sparse_map: SparseMap, map_id: SubmapId, targets: Mapping[KeyframeId, F64], publisher: Publisher,
    publish: PublishConfig,
) -> None:  # fmt: skip
    """Move keyframes to T_w_k (4,4); keyframes without a target move with their parent.

    The first keyframe of a submap keeps its pose in m: the submap is moved instead.
    """
    keyframes = keyframes_of(sparse_map, map_id)
    goal: dict[KeyframeId, F64] = {}
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
    for submap in sparse_map.submaps_of_map(map_id):
        first = sparse_map.submaps[submap][0]
        T_m_k = sparse_map.pose(first)
        fixed = submap == sparse_map.map_id(map_id) and not sparse_map.is_up_to_scale(submap)
        if T_m_k is not None and not fixed:
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
        rotated = float(np.linalg.norm(change[:3, :3] - np.eye(3))) / np.sqrt(2.0)
        if moved > publish.pose_m or rotated > publish.pose_rad:
            sparse_map.set_world_pose(keyframe, goal[keyframe])
            publisher.mark_changed(KeyframePose.KIND, keyframe)


def apply_scales(
    sparse_map: SparseMap, map_id: SubmapId, growth: Mapping[KeyframeId, float], publisher: Publisher
) -> tuple[dict[SubmapId, float], dict[KeyframeId, float]]:  # fmt: skip
    """Multiply lengths near keyframes in w by `growth`.

    The unit of a monocular submap grows by the factor of its newest keyframe, so that nothing changes for the agent
    there; depths of older keyframes take on the rest. Keyframes are not moved. Returns the factors of the units of
    submaps, and the remaining factors by keyframe.
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
                _scale_depths(sparse_map, keyframe, more, publisher)
    return units, left


def scale_map(sparse_map: SparseMap, map_id: SubmapId, factor: float) -> tuple[F64, dict[SubmapId, float]]:
    """Multiply all lengths of a map in w, about its first keyframe.

    Returns the similarity (4,4) by which it moved, and the factors of the units of submaps.
    """
    root = sparse_map.map_id(map_id)
    centre = sim3.place(sparse_map.submap_pose(root), sparse_map.first_pose(root))[:3, 3]
    S_new_old = sim3.of(factor, se3.from_rt(np.eye(3), centre - factor * centre))
    submaps = sparse_map.submaps_of_map(map_id)
    for submap in submaps:
        sparse_map.move_submap(submap, sim3.normalise(S_new_old @ sparse_map.submap_pose(submap)))
    return S_new_old, dict.fromkeys(submaps, factor)


def _scale_depths(sparse_map: SparseMap, keyframe: KeyframeId, factor: float, publisher: Publisher) -> None:
    """Multiply the depths of the landmarks anchored in a keyframe."""
    table, slots = sparse_map.keypoints, sparse_map.slots_of(keyframe)
    offset = table.offset[slots]
    inverse = sparse_map.inverse_depths(slots)
    known = (table.kind[slots] == LANDMARK) & (inverse > 0.0)
    if known.any():
        sparse_map.set_depths(slots[known], (inverse[known] / factor).astype(np.float32), offset[known])
        publisher.mark_changed(RefinedLandmarks.KIND, keyframe)


def full_bundle_window(
    sparse_map: SparseMap, map_id: SubmapId, loops: Sequence[LoopEdge], base: BaseConfig
) -> BundleWindow | None:  # fmt: skip
    """Bundle window of a whole map, or of the part around its newest loop if the map is too large."""
    config = base.graph
    keyframes = [k for k in keyframes_of(sparse_map, map_id) if not sparse_map.keyframes.culled[sparse_map.rows[k]]]
    first = sparse_map.submaps[sparse_map.map_id(map_id)][0]
    if len(keyframes) > config.max_full:
        newest = next((e for e in reversed(loops) if e.new in keyframes), None)
        around = [newest.new, newest.old] if newest is not None else keyframes[-1:]
        near = sparse_map.keyframes.T_w_k[[sparse_map.rows[k] for k in keyframes], :3, 3]
        centres = np.stack([sparse_map.keyframes.T_w_k[sparse_map.rows[k], :3, 3] for k in around])
        distance = np.linalg.norm(near[:, None] - centres, axis=2).min(axis=1)
        keep = np.sort(np.argsort(distance, kind="stable")[: config.max_full])
        keyframes = [keyframes[i] for i in keep.tolist()]
    if len(keyframes) < 2:
        return None
    wide = replace(base.bundle_window, max_fixed=config.max_full // 2)
    return bundle_window(sparse_map, keyframes, wide, base.measurement, {first})

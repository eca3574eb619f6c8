"""Corrections of whole maps: pose graphs and full bundle windows, and how keyframes take on their results."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from kiteline_basestation.config import BaseConfig, GraphConfig, PublishConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.inertial.level import level_of
from kiteline_basestation.map.map_tables import LANDMARK, NO_POSE, REFINED_POSE
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.essential_graph import GraphInputs, Scaled
from kiteline_basestation.merging.loop_edges import LoopEdge, depth_of, graph_edge_of
from kiteline_basestation.refinement.bundle_window import BundleWindow, bundle_window
from kiteline_basestation.refinement.full_bundle_schedule import Part
from kiteline_codec.schema import KeyframePose, RefinedLandmarks
from kiteline_core.arrays import F64, I32, I64, Bool
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import KeyframeId, SubmapId, submap_of_keyframe

_SAME = 1e-4  # relative change of depths that is not sent: a fifth of the code of an inverse depth
_MIN_SHARED = 100  # landmarks of two covisible keyframes joined by an edge
_SIGMA_PATH = 0.01  # share of an edge's length, added to its deviation
_SIGMA_SCALE = 0.003  # of the logarithm of the scale between neighbours in a monocular submap
_LOOP_SIGMA_SCALE = 0.01  # of the logarithm of the scale of a loop edge
_LOOP_SIGMA_DEPTH = 0.005  # of a loop edge: added share of the median depth
_LOOP_SIGMA_RAD = 0.003  # rad; of a loop edge
_SIGMA_M = 0.005  # m; standard deviation of an edge between neighbours
_SIGMA_RAD = 0.003  # rad; of an edge between neighbours


def keyframes_of(sparse_map: SparseMap, map_id: SubmapId) -> list[KeyframeId]:
    """All keyframes of a map that have a pose, in order of id."""
    return [KeyframeId(k) for k in sparse_map.keyframes.id[_posed_rows(sparse_map, map_id)].tolist()]


def _posed_rows(sparse_map: SparseMap, map_id: SubmapId) -> I32:
    rows = sparse_map.rows_of_map(map_id)
    return np.asarray(rows[sparse_map.keyframes.pose_source[rows] != NO_POSE])


def essential_graph_of(
    sparse_map: SparseMap, map_id: SubmapId, loops: Sequence[LoopEdge], config: GraphConfig
) -> GraphInputs | None:  # fmt: skip
    """The essential graph of a map, fixed at the first keyframe of its root submap; None with fewer than two.

    Parts that no edge ties to that keyframe are fixed at their own first ones: a user merged them without matches, or
    what they matched was split off.
    """
    rows = _posed_rows(sparse_map, map_id)
    if len(rows) < 2:
        return None
    keyframes = [KeyframeId(k) for k in sparse_map.keyframes.id[rows].tolist()]
    number = {k: i for i, k in enumerate(keyframes)}
    poses = sparse_map.keyframes.T_w_k[rows]
    above = [number.get(KeyframeId(k), -1) for k in sparse_map.keyframes.parent[rows].tolist()]
    tree = np.array([(p, i) for i, p in enumerate(above) if p >= 0], np.int64).reshape(-1, 2)
    edges = np.unique(np.concatenate([tree, sparse_map.covisible_pairs(rows, _MIN_SHARED)]), axis=0)
    between = np.linalg.inv(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    length = np.linalg.norm(between[:, :3, 3], axis=1)
    sigma = np.column_stack([_SIGMA_M + _SIGMA_PATH * length, np.full(len(edges), _SIGMA_RAD)])
    inside = [e for e in loops if e.old in number and e.new in number]
    loop_edges = [graph_edge_of(sparse_map, e) for e in inside]
    loop_pairs = np.array([[number[e.old], number[e.new]] for e in inside], np.int64).reshape(-1, 2)
    measured = np.array([T for T, _ in loop_edges]).reshape(-1, 4, 4)
    loop_sigma = np.array(
        [[_SIGMA_M + _LOOP_SIGMA_DEPTH * depth_of(sparse_map, e), _LOOP_SIGMA_RAD] for e in inside]
    ).reshape(-1, 2)  # fmt: skip
    root = sparse_map.map_id(map_id)
    first = next((i for i, k in enumerate(keyframes) if submap_of_keyframe(k) == root), 0)
    held = _first_of_parts(len(keyframes), np.concatenate([edges, loop_pairs]), first)
    own = {s for s in sparse_map.submaps_of_map(map_id) if sparse_map.is_up_to_scale(s)}
    scaled = None
    if own:
        free = np.array([submap_of_keyframe(k) in own for k in keyframes])
        scaled = Scaled(
            free, np.concatenate([np.ones(len(edges)), [scale for _, scale in loop_edges]]),
            np.repeat([_SIGMA_SCALE, _LOOP_SIGMA_SCALE], [len(edges), len(loop_pairs)]),
        )  # fmt: skip
    return GraphInputs(
        np.array(keyframes, np.int64), poses, held, np.concatenate([edges, loop_pairs]),
        np.concatenate([between, measured]), np.concatenate([np.round(sigma, 4), np.round(loop_sigma, 4)]),
        np.concatenate([np.zeros(len(edges), np.bool_), np.ones(len(loop_pairs), np.bool_)]), config, scaled,
        level_of(sparse_map, keyframes),
    )  # fmt: skip


def _first_of_parts(count: int, edges: I64, first: int) -> Bool:
    """Whether each of the nodes 0..count is the lowest one of its connected part; `first` counts as the lowest of all.

    edges: (m,2).
    """
    part = np.arange(count)
    part[first] = -1
    while True:
        low = part.copy()
        np.minimum.at(low, edges, part[edges[:, ::-1]])
        if np.array_equal(low, part):
            return np.asarray((part == np.arange(count)) | (np.arange(count) == first))
        part = np.where(low < 0, -1, low[low])


def move_keyframes(
    sparse_map: SparseMap, map_id: SubmapId, targets: Mapping[KeyframeId, F64], publisher: Publisher,
    publish: PublishConfig,
) -> bool:  # fmt: skip
    """Move keyframes to T_w_k (4,4); keyframes without a target move with their parent.

    The first keyframe of a submap keeps its pose in m: the submap is moved instead. Returns True if one was.
    """
    table, rows_by_id = sparse_map.keyframes, sparse_map.rows
    goal = dict(targets)
    here = table.T_w_k[[rows_by_id[k] for k in targets]]
    differ = (np.array(list(targets.values())).reshape(-1, 4, 4) != here).any(axis=(1, 2))
    changed = list(compress(targets, differ.tolist()))
    for keyframe in _carried(sparse_map, map_id, changed, targets):
        parent = KeyframeId(int(table.parent[rows_by_id[keyframe]]))
        above, old = table.T_w_k[rows_by_id[parent]], table.T_w_k[rows_by_id[keyframe]]
        goal[keyframe] = se3.orthonormalise(goal[parent] @ se3.inverse(above) @ old)
    firsts, has_moved = set(), False
    for submap in sparse_map.submaps_of_map(map_id):
        first = sparse_map.submaps[submap][0]
        firsts.add(first)
        T_m_k = sparse_map.pose(first)
        fixed = submap == sparse_map.map_id(map_id) and not sparse_map.is_up_to_scale(submap)
        held = first not in goal or np.array_equal(goal[first], table.T_w_k[rows_by_id[first]])
        if T_m_k is not None and not (fixed or held):
            unit = sparse_map.scale(submap)
            left = [k for k in sparse_map.submaps[submap] if k not in goal]  # these stay in w
            goal |= {k: T for k in left if (T := sparse_map.world_pose(k)) is not None}
            sparse_map.move_submap(submap, sim3.normalise(sim3.of(unit, goal[first]) @ se3.inverse(T_m_k)))
            has_moved = True
    moving = [k for k in sorted(goal) if k not in firsts]
    if not moving:
        return has_moved
    rows, new = np.array([rows_by_id[k] for k in moving]), np.stack([goal[k] for k in moving])
    composed = table.pose_source[rows] != REFINED_POSE  # these are carried along as their parents move
    differs = _differ(table.T_w_k[rows], new, publish)
    set_now = np.flatnonzero(differs & ~composed)
    moved = {moving[i] for i in set_now.tolist()}
    sparse_map.set_world_poses([moving[i] for i in set_now.tolist()], new[set_now])
    for i in np.flatnonzero(composed).tolist():  # parents first
        keyframe, row = moving[i], rows[i]
        if KeyframeId(int(table.parent[row])) in moved:
            sparse_map.compose(keyframe)
            moved.add(keyframe)
        if _differ(table.T_w_k[rows[i : i + 1]], new[i : i + 1], publish)[0]:
            sparse_map.set_world_pose(keyframe, new[i], carry=False)
            moved.add(keyframe)
            set_now = np.append(set_now, i)
    for i in np.sort(set_now).tolist():
        publisher.mark_changed(KeyframePose.KIND, moving[i])
    return has_moved


def _differ(a: F64, b: F64, publish: PublishConfig) -> Bool:
    """Whether poses (n,4,4) differ by as much as is sent."""
    change = np.linalg.inv(a) @ b
    moved = np.linalg.norm(change[:, :3, 3], axis=1)
    rotated = np.linalg.norm(change[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2.0)
    return np.asarray((moved > publish.pose_m) | (rotated > publish.pose_rad))


def _carried(
    sparse_map: SparseMap, map_id: SubmapId, changed: Sequence[KeyframeId], targets: Mapping[KeyframeId, F64]
) -> list[KeyframeId]:  # fmt: skip
    """Descendants of changed keyframes, in order of id, that move along: neither they nor one between has a target."""
    table, open_, out = sparse_map.keyframes, list(changed), list[KeyframeId]()
    if len(targets) == len(keyframes_of(sparse_map, map_id)):
        return out  # all have one
    while open_:
        for row in sparse_map.children_of(open_.pop()):
            child = KeyframeId(int(table.id[row]))
            if child not in targets and table.pose_source[row] != NO_POSE:
                out.append(child)
                open_.append(child)
    return sorted(out)


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


def part_spans(count: int, most: int) -> list[tuple[int, int]]:
    """Begin and end of the parts, which overlap by half, of so many keyframes in a row."""
    half = max(most // 2, 1)
    return [(begin, min(begin + most, count)) for begin in range(0, max(count - half, 1), half)]


def full_bundle_window(
    sparse_map: SparseMap, map_id: SubmapId, loops: Sequence[LoopEdge], base: BaseConfig, part: Part | None = None
) -> BundleWindow | None:  # fmt: skip
    """Bundle window of a whole map; of one that is too large, `part`, or without one what is around its newest loop."""
    config, table = base.graph, sparse_map.keyframes
    rows = _posed_rows(sparse_map, map_id)
    rows = rows[table.culled[rows] == 0]
    first = sparse_map.submaps[sparse_map.map_id(map_id)][0]
    is_large = len(rows) > config.max_full
    if is_large and part is not None:
        submap, number = part
        begin, end = part_spans(len(sparse_map.rows_of(submap)), config.max_full)[number]
        rows = rows[np.isin(rows, sparse_map.rows_of(submap)[begin:end])]
    elif is_large:
        inside = set(table.id[rows].tolist())
        newest = next((e for e in reversed(loops) if e.new in inside), None)
        ends = [int(table.id[rows[-1]])] if newest is None else [newest.new, newest.old]
        around = [sparse_map.rows[KeyframeId(k)] for k in ends]
        apart = table.T_w_k[rows, None, :3, 3] - table.T_w_k[around, :3, 3]
        distance = np.linalg.norm(apart, axis=2).min(axis=1)
        rows = rows[np.sort(np.argsort(distance, kind="stable")[: config.max_full])]
    if len(rows) < 2:
        return None
    keyframes = [KeyframeId(k) for k in table.id[rows].tolist()]
    wide = replace(base.bundle_window, max_fixed=config.max_full // 2)
    return bundle_window(sparse_map, keyframes, wide, base.measurement, {first}, with_children=is_large)

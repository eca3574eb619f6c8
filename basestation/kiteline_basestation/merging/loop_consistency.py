"""Checks that distinguish loop closures from places that only look alike."""

from collections.abc import Sequence

import numpy as np

from kiteline_basestation.config import LoopConfig
from kiteline_basestation.inertial.level import tilt_between
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.loop_edges import LoopEdge, LoopMatch, correction_of, depth_of, similarity
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import KeyframeId, submap_of_keyframe

_PLANE_ROUNDS = 4  # plane fits, each to the points near the last one
_DRIFT_RAD = 0.1  # rad; correction of a loop that drift explains
_DRIFT_RAD_M = 0.002  # rad/m; the same, added for each metre of the path
_DRIFT_APART = 1.0  # of the median depth; from the first to the farthest of the matches: they see other things
_TILT_DEVIATIONS = 4.0  # of what two agents know gravity to, added to the tilt between their maps
_MAX_SCALE_DRIFT = 0.4  # logarithm of the scale drift along a loop
_FUSE_M = 0.02  # m; smaller corrections need no pose graph: landmarks are fused at once
_FUSE_RAD = 0.005  # rad; the same of rotations
_FUSE_SCALE = 0.005  # the same of the logarithm of a scale
_OFF_PLANE = 0.03  # of the median depth; landmarks farther from the common plane lie off it
_MIN_OFF_PLANE = 0.15  # share of landmarks off the plane to merge maps: a wallpaper has copies
_TILT_RAD = 0.05  # rad; by which gravity of two maps may differ that are merged: cameras on worn mounts
MONOCULAR_DRIFT_PATH = 0.05  # share of the path instead of drift_path if the scale drifts too
_AGREE_M = 0.10  # m; between two corrections that agree
_AGREE_DEPTH = 0.04  # added share of the median depth
_AGREE_PATH = 0.02  # added share of the path between the two keyframes
_AGREE_RAD = 0.05  # rad; between two corrections that agree
_AGREE_SCALE = 0.05  # difference of the logarithms of two scales that agree


def agreeing(sparse_map: SparseMap, matches: Sequence[LoopMatch]) -> list[LoopMatch]:
    """Matches that imply the same correction as the last one, up to the drift between their keyframes."""
    table, rows = sparse_map.keyframes, sparse_map.rows
    new, old = (np.array([rows[k] for k in ks]) for ks in ([m.new for m in matches], [m.old for m in matches]))
    T_old_new, T_w_new, T_w_old = np.stack([m.T_old_new for m in matches]), table.T_w_k[new], table.T_w_k[old]
    # The correction maps p to scale R p + t, all in w.
    scale = table.scale[old] * np.array([m.scale for m in matches]) / table.scale[new]
    R_w_old, at_new = T_w_old[:, :3, :3], T_w_new[:, :3, 3]
    R = R_w_old @ T_old_new[:, :3, :3] @ np.swapaxes(T_w_new[:, :3, :3], 1, 2)
    moved = np.einsum("nij,nj->ni", R_w_old, T_old_new[:, :3, 3] * table.scale[old][:, None]) + T_w_old[:, :3, 3]
    t = moved - scale[:, None] * np.einsum("nij,nj->ni", R, at_new)
    submap = submap_of_keyframe(matches[-1].new)
    same = np.array([submap_of_keyframe(m.new) == submap for m in matches])
    back = ~same  # these lead from the other submap to this one: their inverse counts
    R[back] = np.swapaxes(R[back], 1, 2)
    scale[back] = 1.0 / scale[back]
    t[back] = -scale[back, None] * np.einsum("nij,nj->ni", R[back], t[back])

    at = at_new[-1]
    there = scale[:, None] * (R @ at) + t
    apart = np.linalg.norm(there - there[-1], axis=1)
    path = np.where(same, np.linalg.norm(at_new - at, axis=1), 0.0)
    depth = np.array([m.depth_m for m in matches]) * table.scale[old]
    limit = _AGREE_M + _AGREE_DEPTH * np.maximum(depth, depth[-1]) + _AGREE_PATH * path
    chord = np.linalg.norm(R - R[-1], axis=(1, 2)) / np.sqrt(8.0)
    turn = 2.0 * np.arcsin(np.minimum(chord, 1.0))
    fits = (apart <= limit) & (turn <= _AGREE_RAD) & (np.abs(np.log(scale / scale[-1])) <= _AGREE_SCALE)
    return [match for match, fit in zip(matches, fits.tolist()) if fit]


def within_drift(sparse_map: SparseMap, edge: LoopEdge, config: LoopConfig, times: float = 1.0) -> bool:
    """True if the correction of a loop is no larger than the drift expected over the path between its keyframes.

    times: that drift.
    """
    X = correction_of(sparse_map, edge)
    pose = sparse_map.world_pose(edge.new)
    assert pose is not None
    path = path_length(sparse_map, edge.old, edge.new)
    share = config.drift_path
    if any(sparse_map.is_up_to_scale(submap_of_keyframe(k)) for k in (edge.new, edge.old)):
        share = MONOCULAR_DRIFT_PATH + abs(float(np.log(sim3.scale_of(X))))  # scale drift displaces the end of the path
    moved = float(np.linalg.norm(se3.transform(X, pose[None, :3, 3])[0] - pose[:3, 3]))
    return (
        moved <= times * (config.drift_m + share * path)
        and _rotation_between(np.eye(4), X) <= times * (_DRIFT_RAD + _DRIFT_RAD_M * path)
        and abs(float(np.log(sim3.scale_of(X)))) <= _MAX_SCALE_DRIFT
    )


def exceeds_expected_drift(sparse_map: SparseMap, matches: Sequence[LoopMatch], config: LoopConfig) -> bool:
    """True if matches in one submap that agree are so many, and so independent, that drift was larger than expected."""
    strong = [m for m in matches if m.inliers >= config.min_inliers_loop]
    keyframes = sorted({m.new for m in strong})
    if len(keyframes) < config.drift_matches or len({m.old for m in strong}) < config.drift_matches // 2:
        return False
    positions = sparse_map.keyframes.T_w_k[[sparse_map.rows[k] for k in keyframes], :3, 3]
    apart = float(np.linalg.norm(positions - positions[0], axis=1).max())  # a path to and fro shows one thing often
    return (
        apart >= _DRIFT_APART * depth_of(sparse_map, strong[-1])
        and within_drift(sparse_map, strong[-1], config, config.most_drift)
        and keeps_level(sparse_map, strong[-1])
        and has_depth_relief(sparse_map, strong, config)
    )


def keeps_level(sparse_map: SparseMap, edge: LoopEdge) -> bool:
    """False if the correction would tilt one map against the other, as far as both agents know gravity."""
    new, old = submap_of_keyframe(edge.new), submap_of_keyframe(edge.old)
    found = tilt_between(sparse_map, new, old, correction_of(sparse_map, edge))
    return found is None or found[0] <= _TILT_RAD + _TILT_DEVIATIONS * found[1]


def is_fusible(sparse_map: SparseMap, edge: LoopEdge) -> bool:
    """True if the correction of a loop is so small that fusing landmarks and a bundle suffice."""
    S_w_new = similarity(sparse_map, edge.new)
    error = sim3.inverse(S_w_new) @ similarity(sparse_map, edge.old) @ sim3.of(edge.scale, edge.T_old_new)
    moved = float(sim3.scale_of(S_w_new) * np.linalg.norm(error[:3, 3]))
    turned = float(np.linalg.norm(se3.so3_log(sim3.rigid(error)[:3, :3])))
    grown = abs(float(np.log(sim3.scale_of(error))))
    return moved <= _FUSE_M and turned <= _FUSE_RAD and grown <= _FUSE_SCALE


def path_length(sparse_map: SparseMap, a: KeyframeId, b: KeyframeId) -> float:
    """Length in w of the path between two keyframes of one submap, or of both submaps together."""
    total = 0.0
    same = submap_of_keyframe(a) == submap_of_keyframe(b)
    for submap in sorted({submap_of_keyframe(a), submap_of_keyframe(b)}):
        rows = sparse_map.rows_of(submap)
        if same:
            rows = rows[sparse_map.number_of(min(a, b)) : sparse_map.number_of(max(a, b)) + 1]
        positions = sparse_map.keyframes.T_w_k[rows, :3, 3]
        total += float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    return total


def has_depth_relief(sparse_map: SparseMap, matches: Sequence[LoopMatch], config: LoopConfig) -> bool:
    """True if enough matched landmarks lie off their common plane; a flat picture may hang in two places."""
    side = submap_of_keyframe(matches[-1].old)  # landmarks of one map: how the other lies to it is still to be accepted
    ids = np.concatenate(
        [m.old_landmarks if submap_of_keyframe(m.old) == side else m.new_landmarks for m in matches]
    )  # fmt: skip
    xyz, known = sparse_map.positions(np.unique(sparse_map.find_landmarks(ids)))
    xyz = xyz[known]
    if len(xyz) < config.min_inliers:
        return False
    limit = _OFF_PLANE * float(np.median([depth_of(sparse_map, m) for m in matches]))
    inside = np.ones(len(xyz), np.bool_)
    distance = np.zeros(len(xyz))
    for _ in range(_PLANE_ROUNDS):
        centre = xyz[inside].mean(axis=0)
        normal = np.linalg.svd(xyz[inside] - centre, full_matrices=False)[2][2]
        distance = np.abs((xyz - centre) @ normal)
        inside = distance <= max(limit, float(np.median(distance)))
    return float(np.mean(distance > limit)) >= _MIN_OFF_PLANE


def _rotation_between(Sa: F64, Sb: F64) -> float:
    """Angle in rad between two similarities (4,4)."""
    return float(np.linalg.norm(se3.so3_log(se3.orthonormalise(sim3.inverse(Sa) @ Sb)[:3, :3])))

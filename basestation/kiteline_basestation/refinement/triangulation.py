"""Triangulates landmarks without depth, from their observations and from epipolar matches of new landmarks.

Source: "Monocular EKF-SLAM with delayed landmark initialisation" (the point nearest to all rays), with the parallax and
reprojection tests of ORB-SLAM2.
"""

import numpy as np

from kiteline_basestation.config import TriangulationConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.map_tables import CULLED, LANDMARK, REMOVED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement import landmark_matching_kernels as kernels
from kiteline_basestation.refinement.landmark_matching import descriptors, fuse_landmarks
from kiteline_codec.schema import RefinedLandmarks
from kiteline_core.arrays import F64, I32, Bool
from kiteline_core.geometry.se3 import skew
from kiteline_core.geometry.triangulation import nearest_point, parallax, project, rays
from kiteline_core.ids import KeyframeId

_MAX_COVISIBLE = 6  # covisible keyframes searched
_MIN_BASELINE_RATIO = 0.01  # baseline over median depth: below it two keyframes have one viewpoint
_RATIO = 0.75  # best over second-best distance
_REPROJECTION_PX = 2.0  # px at octave 0; in every view


def triangulate_landmarks(
    sparse_map: SparseMap, keyframe: KeyframeId, config: TriangulationConfig, publisher: Publisher
) -> int:
    """Triangulate landmarks of a new keyframe that have no depth. Returns the number triangulated."""
    return _from_observations(sparse_map, keyframe, config, publisher) + _from_epipolar_matches(
        sparse_map, keyframe, config, publisher
    )


def _without_depth(sparse_map: SparseMap, points: I32) -> I32:
    _, known = sparse_map.positions(points)
    return points[~known]


def _from_observations(
    sparse_map: SparseMap, keyframe: KeyframeId, config: TriangulationConfig, publisher: Publisher
) -> int:
    """Landmarks that several keyframes observe, from the first and the last observation."""
    points = _without_depth(sparse_map, sparse_map.landmarks_of(keyframe))
    starts, slots = sparse_map.observations(points)
    several = np.diff(starts) >= 2
    points = points[several]
    if len(points) == 0:
        return 0
    first, last = slots[starts[:-1][several]], slots[starts[1:][several] - 1]
    position, good = _intersect(sparse_map, first, last, config)
    return _set_positions(sparse_map, points[good], position[good], publisher)


def _from_epipolar_matches(
    sparse_map: SparseMap, keyframe: KeyframeId, config: TriangulationConfig, publisher: Publisher
) -> int:
    """New landmarks without depth of this keyframe, matched with those of covisible ones."""
    table, keyframes = sparse_map.keypoints, sparse_map.keyframes
    row = sparse_map.rows[keyframe]
    triangulated = 0
    seen = sparse_map.landmarks_of(keyframe)
    inverse = sparse_map.inverse_depths(seen) / keyframes.scale[table.row[seen]]
    inverse = inverse[inverse > 0]
    here = _new_without_depth(sparse_map, keyframe)
    for other in sparse_map.covisible_keyframes(keyframe, 1)[:_MAX_COVISIBLE]:
        if len(here) == 0:
            break
        there = _new_without_depth(sparse_map, other)
        if len(there) == 0:
            continue
        T_w_a, T_w_b = keyframes.T_w_k[row], keyframes.T_w_k[sparse_map.rows[other]]
        baseline = float(np.linalg.norm(T_w_a[:3, 3] - T_w_b[:3, 3]))
        if len(inverse) and baseline * float(np.median(inverse)) < _MIN_BASELINE_RATIO:
            continue
        rotation = T_w_b[:3, :3].T @ T_w_a[:3, :3]
        essential = skew(T_w_b[:3, :3].T @ (T_w_a[:3, 3] - T_w_b[:3, 3])) @ rotation
        k_a, k_b = _matrix(keyframes.camera[row]), _matrix(keyframes.camera[sparse_map.rows[other]])
        fundamental = np.linalg.inv(k_b).T @ essential @ np.linalg.inv(k_a)
        best, distance = np.empty(len(here), np.int32), np.zeros(len(here), np.int32)
        ours, theirs = descriptors(sparse_map, here, there)
        kernels.match_epipolar(
            table.uv[here].astype(np.float64), table.octave[here], ours,
            table.uv[there].astype(np.float64), table.octave[there], theirs,
            fundamental, config.epipolar_px, config.max_hamming, _RATIO, best, distance,
        )  # fmt: skip
        matched = best >= 0
        a, b = here[matched], there[best[matched]]
        position, good = _intersect(sparse_map, a, b, config)
        for i in np.flatnonzero(good).tolist():
            if fuse_landmarks(sparse_map, int(a[i]), int(b[i]), publisher):
                root = table.root[a[i : i + 1]]
                triangulated += _set_positions(sparse_map, root, position[i : i + 1], publisher)
        here = here[table.root[here] == here]
    return triangulated


def _new_without_depth(sparse_map: SparseMap, keyframe: KeyframeId) -> I32:
    """Root landmarks of a keyframe that have no depth."""
    table = sparse_map.keypoints
    slots = sparse_map.slots_of(keyframe)
    own = (
        (table.kind[slots] == LANDMARK) & (table.root[slots] == slots) & (table.flags[slots] & (REMOVED | CULLED) == 0)
    )
    return _without_depth(sparse_map, slots[own])


def _set_positions(sparse_map: SparseMap, points: I32, position: F64, publisher: Publisher) -> int:
    inverse, offset, ahead = sparse_map.project_into_anchor(points, position)
    sparse_map.set_depths(points[ahead], inverse[ahead], offset[ahead])
    publisher.mark_changed_slots(RefinedLandmarks.KIND, points[ahead])
    return int(np.count_nonzero(ahead))


def _intersect(sparse_map: SparseMap, a: I32, b: I32, config: TriangulationConfig) -> tuple[F64, Bool]:
    """Positions (n,3) from rays of keypoints a and b (n,), and whether parallax, depth and reprojection are good."""
    table, keyframes = sparse_map.keypoints, sparse_map.keyframes
    views = []
    for slots in (a, b):
        rows = table.row[slots]
        views.append((table.uv[slots].astype(np.float64), keyframes.camera[rows, :4], keyframes.T_w_k[rows]))
    lines = [rays(*view) for view in views]
    position, good = nearest_point(
        np.stack([lines[0][0], lines[1][0]], 1), np.stack([lines[0][1], lines[1][1]], 1)
    )  # fmt: skip
    good &= parallax(lines[0][0], lines[1][0], position) < config.max_cosine
    for slots, (uv, camera, T_w_k) in zip((a, b), views, strict=True):
        pixel, depth = project(position, camera, T_w_k)
        limit = _REPROJECTION_PX * np.exp2(table.octave[slots])
        good &= (depth > 0.05) & (np.linalg.norm(pixel - uv, axis=1) < limit)
    return position, good


def _matrix(camera: F64) -> F64:
    return np.array([[camera[0], 0.0, camera[2]], [0.0, camera[1], camera[3]], [0.0, 0.0, 1.0]])

"""Gives depth to points that stereo could not measure: from their sightings, and from births along epipolar lines.

Source: the analytical initialisation of "Monocular EKF-SLAM with delayed landmark initialisation" (the point nearest
to all rays), with the tests of parallax and reprojection of ORB-SLAM2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import MeasurementConfig, TriangulationConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.map_tables import CULLED, LANDMARK, REMOVED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement import landmark_matching_kernels as kernels
from kiteline_basestation.refinement.landmark_matching import descriptors, fuse_landmarks
from kiteline_codec.schema import RefinedLandmarks
from kiteline_core.geometry.se3 import skew
from kiteline_core.geometry.triangulation import nearest_point, parallax, project, rays
from kiteline_core.ids import KeyframeId

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Bool = NDArray[np.bool_]


def triangulate_landmarks(
    sparse_map: SparseMap,
    keyframe: KeyframeId,
    config: TriangulationConfig,
    measurement: MeasurementConfig,
    publisher: Publisher,
) -> int:
    """Give depth to what a new keyframe sees and nobody could measure. Returns how many points got one."""
    return _from_sightings(sparse_map, keyframe, config, publisher) + _from_births(
        sparse_map, keyframe, config, publisher
    )


def _without_depth(sparse_map: SparseMap, points: I32) -> I32:
    _, known = sparse_map.positions(points)
    return points[~known]


def _from_sightings(
    sparse_map: SparseMap, keyframe: KeyframeId, config: TriangulationConfig, publisher: Publisher
) -> int:
    """Points that several keyframes see: from the two outermost views, tested in all of them."""
    points = _without_depth(sparse_map, sparse_map.landmarks_of(keyframe))
    starts, slots = sparse_map.observations(points)
    several = np.diff(starts) >= 2
    points = points[several]
    if len(points) == 0:
        return 0
    first, last = slots[starts[:-1][several]], slots[starts[1:][several] - 1]
    return _make(sparse_map, points, first, last, config, publisher)


def _from_births(sparse_map: SparseMap, keyframe: KeyframeId, config: TriangulationConfig, publisher: Publisher) -> int:
    """Births without depth of this keyframe and of covisible ones that are one point."""
    table, keyframes = sparse_map.keypoints, sparse_map.keyframes
    row = sparse_map.rows[keyframe]
    made = 0
    seen = sparse_map.landmarks_of(keyframe)
    inverse = sparse_map.inverse_depths(seen) / keyframes.scale[table.row[seen]]
    inverse = inverse[inverse > 0]
    here = _open_births(sparse_map, keyframe)
    for other in sparse_map.covisible_keyframes(keyframe, 1)[: config.max_covisible]:
        if len(here) == 0:
            break
        there = _open_births(sparse_map, other)
        if len(there) == 0:
            continue
        T_m_a, T_m_b = keyframes.T_w_k[row], keyframes.T_w_k[sparse_map.rows[other]]
        baseline = float(np.linalg.norm(T_m_a[:3, 3] - T_m_b[:3, 3]))
        if len(inverse) and baseline * float(np.median(inverse)) < config.min_baseline_ratio:
            continue
        rotation = T_m_b[:3, :3].T @ T_m_a[:3, :3]
        essential = skew(T_m_b[:3, :3].T @ (T_m_a[:3, 3] - T_m_b[:3, 3])) @ rotation
        k_a, k_b = _matrix(keyframes.camera[row]), _matrix(keyframes.camera[sparse_map.rows[other]])
        fundamental = np.linalg.inv(k_b).T @ essential @ np.linalg.inv(k_a)
        best, distance = np.empty(len(here), np.int32), np.zeros(len(here), np.int32)
        ours, theirs = descriptors(sparse_map, here, there)
        kernels.match_epipolar(
            table.uv[here].astype(np.float64), table.octave[here], ours,
            table.uv[there].astype(np.float64), table.octave[there], theirs,
            fundamental, config.epipolar_px, config.max_hamming, config.ratio, best, distance,
        )  # fmt: skip
        matched = best >= 0
        a, b = here[matched], there[best[matched]]
        position, good = _intersect(sparse_map, a, b, config)
        for i in np.flatnonzero(good).tolist():
            if fuse_landmarks(sparse_map, int(a[i]), int(b[i]), publisher):
                root = table.root[a[i : i + 1]]
                made += _set(sparse_map, root, position[i : i + 1], publisher)
        here = here[table.root[here] == here]
    return made


def _open_births(sparse_map: SparseMap, keyframe: KeyframeId) -> I32:
    """Births of a keyframe that are their own root and have no depth."""
    table = sparse_map.keypoints
    slots = sparse_map.slots_of(keyframe)
    own = (
        (table.kind[slots] == LANDMARK) & (table.root[slots] == slots) & (table.flags[slots] & (REMOVED | CULLED) == 0)
    )
    return _without_depth(sparse_map, slots[own])


def _make(
    sparse_map: SparseMap, points: I32, first: I32, last: I32, config: TriangulationConfig, publisher: Publisher
) -> int:
    position, good = _intersect(sparse_map, first, last, config)
    return _set(sparse_map, points[good], position[good], publisher)


def _set(sparse_map: SparseMap, points: I32, position: F64, publisher: Publisher) -> int:
    inverse, offset, ahead = sparse_map.project_into_anchor(points, position)
    sparse_map.set_depths(points[ahead], inverse[ahead], offset[ahead])
    publisher.mark_changed_slots(RefinedLandmarks.KIND, points[ahead])
    return int(np.count_nonzero(ahead))


def _intersect(sparse_map: SparseMap, a: I32, b: I32, config: TriangulationConfig) -> tuple[F64, Bool]:
    """Points from the rays of keypoints a and b (n,), and whether parallax, depth and reprojection allow them."""
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
    for slots, (uv, camera, T_m_k) in zip((a, b), views, strict=True):
        pixel, depth = project(position, camera, T_m_k)
        limit = config.reprojection_px * np.exp2(table.octave[slots])
        good &= (depth > 0.05) & (np.linalg.norm(pixel - uv, axis=1) < limit)
    return position, good


def _matrix(camera: F64) -> F64:
    return np.array([[camera[0], 0.0, camera[2]], [0.0, camera[1], camera[3]], [0.0, 0.0, 1.0]])

"""Matches known landmarks with an agent's new ones by projection, and fuses them.

Known landmarks are projected into a new keyframe, and its new landmarks into older keyframes ("DS-PTAM: a distributed
stereo PTAM", sections 2.4.4 and 3.1.2). The older landmark of a match becomes the root.
"""

import numpy as np

from kiteline_basestation.config import LandmarkMatchingConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.map_tables import CULLED, LANDMARK, NO_POSE, REFINED, REMOVED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement import landmark_matching_kernels as kernels
from kiteline_codec.schema import FusedLandmarks, RefinedLandmarks
from kiteline_core.arrays import F64, I32, U8, U64
from kiteline_core.ids import KeyframeId, agent_of_keyframe, submap_of_keyframe
from kiteline_core.imaging.descriptors import comparable

_MAX_COVISIBLE = 12  # covisible keyframes searched
_MAX_NEARBY = 8  # other keyframes searched that view the same place: revisits
_NEAR_RATIO = 0.5  # distance of such a keyframe over the median depth
_NEAR_COSINE = 0.7  # cosine of the angle between the optical axes: 45 degrees
_OCTAVE_GAP = 1.2  # octaves between the predicted and the detected scale
_ANGLE_GAP = 24  # 1/256 turns; between the predicted and the detected orientation: 34 degrees
_RATIO = 0.8  # best over second-best distance: below it, a match is distinct


def match_landmarks(
    sparse_map: SparseMap, keyframe: KeyframeId, config: LandmarkMatchingConfig, publisher: Publisher
) -> int:
    """Match a new keyframe with those that view the same place. Returns the number of fused landmarks."""
    others = nearby_keyframes(sparse_map, keyframe)
    if not others:
        return 0
    fused = 0
    known = sparse_map.sorted_by_id(np.concatenate([sparse_map.landmarks_of(k) for k in others]))
    known = known[~np.isin(known, sparse_map.landmarks_of(keyframe))]
    fused += _match_projected(sparse_map, known, keyframe, config, publisher)
    new = _new_landmarks(sparse_map, keyframe)
    for other in others:
        if found := _match_projected(sparse_map, new, other, config, publisher):
            fused += found
            new = _new_landmarks(sparse_map, keyframe)
    return fused


def _new_landmarks(sparse_map: SparseMap, keyframe: KeyframeId) -> I32:
    """Root landmarks that a keyframe is the first to observe, in order of id."""
    observed = sparse_map.landmarks_of(keyframe)
    return np.asarray(observed[sparse_map.keypoints.row[observed] == sparse_map.rows[keyframe]])


def nearby_keyframes(sparse_map: SparseMap, keyframe: KeyframeId) -> list[KeyframeId]:
    """Covisible keyframes, then those that are near and have a similar viewing direction."""
    covisible = sparse_map.covisible_keyframes(keyframe, 1)[:_MAX_COVISIBLE]
    table, row = sparse_map.keyframes, sparse_map.rows[keyframe]
    points = sparse_map.landmarks_of(keyframe)
    inverse = sparse_map.inverse_depths(points) / table.scale[sparse_map.keypoints.row[points]]
    inverse = inverse[inverse > 0]
    if len(inverse) == 0:
        return covisible
    reach = _NEAR_RATIO / float(np.median(inverse))
    rows = sparse_map.rows_near(submap_of_keyframe(keyframe), table.T_w_k[row, :3, 3], reach)
    poses = table.T_w_k[rows]
    distance = np.linalg.norm(poses[:, :3, 3] - table.T_w_k[row, :3, 3], axis=1)
    cosine = poses[:, :3, 2] @ table.T_w_k[row, :3, 2]
    near = (distance < reach) & (cosine > _NEAR_COSINE) & (table.pose_source[rows] != NO_POSE)
    near &= (rows != row) & (table.culled[rows] == 0) & (table.camera[rows, 0] > 0.0)  # no camera: still to come
    ids = table.id[rows[near]]
    order = np.lexsort((ids, distance[near]))
    taken = set(covisible)
    extra = [k for k in map(KeyframeId, ids[order].tolist()) if k not in taken]
    return covisible + extra[:_MAX_NEARBY]


def _match_projected(
    sparse_map: SparseMap, points: I32, target: KeyframeId, config: LandmarkMatchingConfig, publisher: Publisher
) -> int:
    """Match root landmarks (n,) with the new landmarks of a keyframe and fuse the matches. Returns their number."""
    table = sparse_map.keypoints
    slots = sparse_map.slots_of(target)
    slots = slots[(table.kind[slots] == LANDMARK) & (table.flags[slots] & (REMOVED | CULLED) == 0)]
    slots = slots[table.flags[table.root[slots]] & CULLED == 0]
    if len(points) == 0 or len(slots) == 0:
        return 0
    points, uv, octave, angle, disparity = predict_projections(sparse_map, points, target)
    if len(points) == 0:
        return 0
    row = sparse_map.rows[target]
    bf = sparse_map.keyframes.camera[row, 4]
    ranged = (table.inv_depth[slots] > 0) & (not sparse_map.is_up_to_scale(submap_of_keyframe(target)))
    measured = np.where(ranged, bf * table.inv_depth[slots], -1.0).astype(np.float64)
    best = np.empty(len(points), np.int32)
    distance = np.zeros(len(points), np.int32)
    projected, detected = descriptors(sparse_map, points, slots)
    kernels.match_projected(
        uv, octave, angle, disparity, projected,
        table.uv[slots].astype(np.float64), table.octave[slots], table.angle[slots], measured,
        detected,
        config.radius_px, _OCTAVE_GAP, _ANGLE_GAP, config.disparity_px, config.max_hamming, _RATIO,
        best, distance,
    )  # fmt: skip
    fused = 0
    for i in np.flatnonzero(best >= 0).tolist():
        fused += fuse_landmarks(sparse_map, int(points[i]), int(table.root[slots[best[i]]]), publisher)
    return fused


def predict_projections(
    sparse_map: SparseMap, points: I32, target: KeyframeId, T_w_k: F64 | None = None
) -> tuple[I32, F64, F64, U8, F64]:  # fmt: skip
    """Predict pixel, octave, angle and disparity of landmarks (n,) in a keyframe; returns those inside its image.

    T_w_k: (4,4) pose to assume for the keyframe; None: its pose in the map.
    """
    table, keyframes = sparse_map.keypoints, sparse_map.keyframes
    row = sparse_map.rows[target]
    xyz, known = sparse_map.positions(points)
    points, xyz = points[known], xyz[known]
    T = keyframes.T_w_k[row] if T_w_k is None else T_w_k
    local = (xyz - T[:3, 3]) @ T[:3, :3]
    fx, fy, cx, cy, bf = keyframes.camera[row]
    z = np.maximum(local[:, 2], 1e-3)
    uv = np.stack([fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy], 1)
    camera = sparse_map.cameras[agent_of_keyframe(target)]
    inside = (local[:, 2] > 0.1) & (uv >= 0).all(axis=1) & (uv < (camera.width, camera.height)).all(axis=1)
    points, uv, z, xyz = points[inside], uv[inside], z[inside], xyz[inside]
    anchors = keyframes.T_w_k[table.row[points]]
    depth = np.einsum("ni,ni->n", anchors[:, :3, 2], xyz - anchors[:, :3, 3])
    octave = table.octave[points] + np.log2(np.maximum(depth, 1e-3) / z)
    R_k_a = np.einsum("ji,njk->nik", T[:3, :3], anchors[:, :3, :3])  # anchor to target
    roll = np.arctan2(R_k_a[:, 1, 0] - R_k_a[:, 0, 1], R_k_a[:, 0, 0] + R_k_a[:, 1, 1])
    angle = (table.angle[points].astype(np.int64) + np.rint(roll * (128.0 / np.pi)).astype(np.int64)) & 255
    return points, uv, octave, angle.astype(np.uint8), bf / z


def descriptors(sparse_map: SparseMap, a: I32, b: I32) -> tuple[U64, U64]:
    """Comparable descriptors (n,4) and (m,4) uint64 of two sets of landmarks."""
    of = sparse_map.keypoints.descriptor
    left, right = comparable(of[a], of[b])
    return np.ascontiguousarray(left).view(np.uint64), np.ascontiguousarray(right).view(np.uint64)


def fuse_landmarks(sparse_map: SparseMap, a: int, b: int, publisher: Publisher) -> bool:
    """Fuse two root landmarks into the older one, which gets a depth if only the other has one.

    Returns False if a keyframe observes both.
    """
    if a == b or sparse_map.observed_together(a, b):
        return False
    ids = sparse_map.landmark_ids(np.array([a, b], np.int32))
    parent, child = (a, b) if ids[0] < ids[1] else (b, a)
    if not sparse_map.has_position(parent) and sparse_map.has_position(child):
        one = np.array([parent], np.int32)
        xyz, _ = sparse_map.positions(np.array([child], np.int32))
        inverse, offset, ahead = sparse_map.project_into_anchor(one, xyz)
        if not ahead[0]:
            return False
        sparse_map.set_depths(one, inverse, offset)
        publisher.mark_changed_slots(RefinedLandmarks.KIND, one)
    if sparse_map.keypoints.flags[child] & REFINED:
        publisher.mark_changed_slots(
            RefinedLandmarks.KIND, np.array([child], np.int32)
        )  # it leaves the RefinedLandmarks record of its keyframe
    for keyframe in sparse_map.fuse(child, parent):
        publisher.mark_changed(FusedLandmarks.KIND, keyframe)
    return True

"""Applies the result of a bundle to the map: poses, landmark positions, rejected observations."""

from dataclasses import replace

import numpy as np

from kiteline_basestation.config import PublishConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.inertial.units import unit_in
from kiteline_basestation.map.map_tables import CULLED, LANDMARK, REFINED_POSE, REMOVED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.bundle_window import BundleWindow
from kiteline_codec.schema import CulledLandmarks, KeyframePose, RefinedLandmarks, RemovedObservations
from kiteline_core.arrays import F64, I32, Bool
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import virtual_bf
from kiteline_core.ids import SEQUENCE_BITS, KeyframeId, SubmapId
from kiteline_core.optimisation.bundle import BundleResult

_ENDS = 20  # keyframes at the begin or the end of a submap whose steps tell its unit there: single steps may be torn
_MIN_OBSERVATIONS = 2  # observations that must remain after the outlier test
_MAX_OFFSET_PX = 8.0  # px at octave 0; from the keypoint to the refined projection: more is another landmark


def apply_bundle(
    sparse_map: SparseMap, window: BundleWindow, result: BundleResult, publisher: Publisher, publish: PublishConfig
) -> None:
    """Write the results that differ enough from what both sides hold; a result that is not finite is dropped."""
    if not (np.isfinite(result.T_c_m).all() and np.isfinite(result.points).all()):
        return
    before = sparse_map.keyframes.T_w_k[window.rows].copy()
    _poses(sparse_map, window, result, publisher, publish)
    _move_culled(sparse_map, window, before, publisher)
    dropped = _observations(sparse_map, window, result, publisher)
    _points(sparse_map, window, result, dropped, publisher, publish)


def _poses(
    sparse_map: SparseMap, window: BundleWindow, result: BundleResult, publisher: Publisher, publish: PublishConfig
) -> None:
    for i in np.flatnonzero(window.problem.free).tolist():
        row = int(window.rows[i])
        keyframe = KeyframeId(int(sparse_map.keyframes.id[row]))
        new = np.linalg.inv(result.T_c_m[i])
        old = sparse_map.keyframes.T_w_k[row]
        moved = float(np.linalg.norm(new[:3, 3] - old[:3, 3]))
        rotated = float(np.linalg.norm(new[:3, :3] - old[:3, :3])) / np.sqrt(2.0)  # chord: the angle when small
        first = sparse_map.keyframes.pose_source[row] != REFINED_POSE  # replaces the value of an earlier base
        if first or moved > publish.pose_m or rotated > publish.pose_rad:
            sparse_map.set_world_pose(keyframe, new)
            publisher.mark_changed(KeyframePose.KIND, keyframe)


def _move_culled(sparse_map: SparseMap, window: BundleWindow, before: F64, publisher: Publisher) -> None:
    """Move culled keyframes, which have no observations, along with their nearest ancestor in the window."""
    table = sparse_map.keyframes
    inside = set(window.rows.tolist())
    for i, moved in enumerate(window.rows.tolist()):
        if np.array_equal(before[i], table.T_w_k[moved]):
            continue
        motion = table.T_w_k[moved] @ np.linalg.inv(before[i])
        open_, along = [moved], list[int]()
        while open_:
            children = sparse_map.children_of(KeyframeId(int(table.id[open_.pop()])))
            below = [row for row in children if table.culled[row] and row not in inside]
            open_ += below
            along += below
        for row in sorted(along):
            keyframe = KeyframeId(int(table.id[row]))
            sparse_map.set_world_pose(keyframe, se3.orthonormalise(motion @ table.T_w_k[row]))
            publisher.mark_changed(KeyframePose.KIND, keyframe)


def _observations(sparse_map: SparseMap, window: BundleWindow, result: BundleResult, publisher: Publisher) -> Bool:
    """Remove outliers, and cull landmarks with too few observations left. Returns which of the window (n,)."""
    table = sparse_map.keypoints
    starts = window.problem.starts
    which = np.repeat(np.arange(len(window.points)), np.diff(starts))
    current = table.root[window.slots] == window.points[which]  # else it was fused or removed meanwhile
    bad = window.slots[~result.inlier & current]
    if len(bad):
        sparse_map.set_flags(bad, REMOVED)
        publisher.mark_changed_slots(RemovedObservations.KIND, bad)
    left = np.diff(sparse_map.observations(window.points)[0])
    dropped = np.asarray((left < _MIN_OBSERVATIONS) & (table.root[window.points] == window.points))
    cull_landmarks(sparse_map, window.points[dropped], publisher)
    return dropped


def _points(
    sparse_map: SparseMap, window: BundleWindow, result: BundleResult, dropped: Bool, publisher: Publisher,
    publish: PublishConfig,
) -> None:  # fmt: skip
    table = sparse_map.keypoints
    alive = ~dropped & (table.root[window.points] == window.points) & (table.flags[window.points] & CULLED == 0)
    points, positions = window.points[alive], result.points[alive]
    inv, offset, ahead = sparse_map.project_into_anchor(points, positions)
    too_far = ~ahead | (np.abs(offset).max(axis=1, initial=0.0) > _MAX_OFFSET_PX * np.exp2(table.octave[points]))
    cull_landmarks(sparse_map, points[too_far], publisher)
    points, inv, offset = points[~too_far], inv[~too_far], offset[~too_far]
    change = np.maximum(
        np.abs(inv - sparse_map.inverse_depths(points)) * _virtual_bf(sparse_map, points),
        np.abs(offset - table.offset[points]).max(axis=1, initial=0.0),
    )
    moved = points[change > publish.depth_px]
    if len(moved):
        sparse_map.set_depths(moved, inv[change > publish.depth_px], offset[change > publish.depth_px])
        publisher.mark_changed_slots(RefinedLandmarks.KIND, moved)


def _virtual_bf(sparse_map: SparseMap, points: I32) -> F64:
    """Focal length in px times baseline, by which depths of landmarks (n,) are compared in px of disparity.

    In metres that of the camera; in a unit of its own see `virtual_bf`.
    """
    keyframes, rows = sparse_map.keyframes, sparse_map.keypoints.row[points]
    bf: F64 = keyframes.camera[rows, 4].copy()
    submap = keyframes.id[rows] >> SEQUENCE_BITS
    own = [s for s in np.unique(submap).tolist() if sparse_map.is_up_to_scale(SubmapId(s))]
    for row in np.unique(rows[np.isin(submap, own)]).tolist():
        here = rows == row
        rho = sparse_map.inverse_depths(points[here])
        if (known := rho > 0.0).any():
            bf[here] = virtual_bf(float(keyframes.camera[row, 4]), rho[known])
    return bf


def keep_scales(
    sparse_map: SparseMap, map_id: SubmapId, window: BundleWindow, result: BundleResult
) -> tuple[BundleResult, dict[SubmapId, float]]:  # fmt: skip
    """Set the units of monocular submaps to what a full bundle found.

    Agents tell their steps in the unit of their submap. Its placement has the length of that at the newest keyframes,
    so that nothing changes for the agent there. If the whole map has no metric scale, lengths in w are those that were
    told at its oldest keyframes. Neither is by what the map held before, or it would grow a little with each bundle:
    values that a bundle hardly changes stay as they are, in the unit of before. Agents take the unit of a submap in
    metres for a metre: once inertial steps tell lengths in w, it is one, and these agents are told corrected lengths.
    Returns the result, and the factors by submap.
    """
    submaps = sparse_map.submaps_of_map(map_id)
    root, rows, T_c_m = sparse_map.map_id(map_id), window.rows, result.T_c_m
    poses = np.linalg.inv(T_c_m)
    place = np.asarray(poses[:, :3, 3], np.float64)
    units = {
        s: unit_in(sparse_map, sparse_map.submaps[s][-_ENDS:], rows, place) or sparse_map.scale(s)
        for s in submaps
        if sparse_map.is_up_to_scale(s)
    }
    if sparse_map.is_up_to_scale(root):
        whole = unit_in(sparse_map, sparse_map.submaps[root][:_ENDS], rows, place) or 1.0
        centre = sim3.place(sparse_map.submap_pose(root), sparse_map.first_pose(root))[:3, 3]
        poses[:, :3, 3] = centre + (place - centre) / whole
        result = replace(result, T_c_m=np.linalg.inv(poses), points=centre + (result.points - centre) / whole)
        units = {submap: unit / whole for submap, unit in units.items()}
    elif result.scale_sigma > 0.0:
        scaled = [s for s in submaps if sparse_map.has_metric_scale_by_imu(s)]
        units |= {s: 1.0 for s in scaled if sparse_map.scale(s) != 1.0}
        sparse_map.scaled_submaps.update(scaled)
    factors = {submap: unit / sparse_map.scale(submap) for submap, unit in units.items()}
    for submap, factor in factors.items():
        sparse_map.scale_submap(submap, factor)
    return result, factors


def cull_landmarks(sparse_map: SparseMap, points: I32, publisher: Publisher) -> None:
    """Cull landmarks (n,)."""
    points = points[sparse_map.keypoints.kind[points] == LANDMARK]
    if len(points):
        sparse_map.set_flags(points, CULLED)
        publisher.mark_changed_slots(CulledLandmarks.KIND, points)

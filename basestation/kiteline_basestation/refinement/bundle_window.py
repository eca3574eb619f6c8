"""The part of the map that a bundle adjusts, as a bundle problem."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kiteline_basestation.config import BundleWindowConfig, MeasurementConfig
from kiteline_basestation.map.map_tables import LANDMARK, NO_POSE
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.disparity_calibration import offsets
from kiteline_core.arrays import F64, I32
from kiteline_core.ids import BOOT_BITS, SEQUENCE_BITS, SUBMAP_BITS, AgentId, KeyframeId, submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleProblem

_SIGMA_GROWTH = 2.0  # factor per octave: of aligned keypoints and disparities, tails included
_SIGMA_CALIBRATED_PX = 0.1  # px at octave 0; of a disparity once the agent's disparity offset is known
_SIGMA_FUSED_PX = 0.6  # px at octave 0; of a new landmark that was fused: two detections of one corner
_SIGMA_FUSED_GROWTH = 2.0  # factor per octave; corners are detected to a fraction of the octave's pixels
_MIN_LANDMARKS = 20  # landmarks of a bundle: fewer do not constrain the poses
MIN_SHARED = 12  # landmarks that two covisible keyframes share


@dataclass(frozen=True, slots=True)
class BundleWindow:
    """A part of the map as rows and slots, and its bundle problem in the same order."""

    rows: I32  # (k,) keyframe rows
    points: I32  # (n,) slots of root landmarks
    slots: I32  # (m,) slots of the observations
    problem: BundleProblem


def local_keyframes(sparse_map: SparseMap, keyframe: KeyframeId, config: BundleWindowConfig) -> list[KeyframeId]:
    """A keyframe and its most covisible ones, which a local bundle around it adjusts."""
    free = [keyframe, *sparse_map.covisible_keyframes(keyframe, MIN_SHARED)[: config.max_free - 1]]
    parent = keyframe
    while len(free) < config.max_free // 2:  # few shared landmarks: add ancestors
        parent = KeyframeId(int(sparse_map.keyframes.parent[sparse_map.rows[parent]]))
        if parent not in sparse_map or sparse_map.pose(parent) is None:
            break
        if parent not in free:
            free.append(parent)
    return free


def bundle_window(
    sparse_map: SparseMap, free: list[KeyframeId], config: BundleWindowConfig, measurement: MeasurementConfig,
    held: set[KeyframeId] | None = None, *, with_children: bool = False,
) -> BundleWindow | None:  # fmt: skip
    """Bundle problem with `free` keyframes of one map, their landmarks, and fixed keyframes that observe these; None if
    it is too small.

    held: keyframes that stay fixed; by default the first one of each submap. with_children: hold those whose parent,
    but for culled ones between, is free as well.
    """
    table, keyframes = sparse_map.keypoints, sparse_map.keyframes
    submaps = sparse_map.submaps_of_map(submap_of_keyframe(free[0]))
    held = {sparse_map.submaps[s][0] for s in submaps} if held is None else held
    points = sparse_map.landmarks_of_all(free)
    _, known = sparse_map.positions(points)
    points = points[known]
    starts, slots = sparse_map.observations(points)
    which = np.repeat(np.arange(len(points), dtype=np.int32), np.diff(starts))

    # Keep the free keyframes, and of the others those that observe most.
    free_rows = np.array([sparse_map.rows[k] for k in free], np.int32)
    counts = np.bincount(table.row[slots], minlength=sparse_map.height)
    mask = np.zeros(sparse_map.height, bool)
    mask[sparse_map.rows_of_map(submaps[0])] = True
    mask &= keyframes.pose_source[: sparse_map.height] != NO_POSE
    counts[~mask] = 0
    counts[free_rows] = 0
    others = np.flatnonzero(counts > 0)
    order = np.lexsort((-keyframes.id[others], -counts[others]))
    others = others[order[: config.max_fixed]].astype(np.int32)
    # Odometry ties keyframes to their parents: without these, few observations elsewhere would carry all of them away.
    parents = np.array([sparse_map.rows.get(KeyframeId(int(p)), -1) for p in keyframes.parent[free_rows]], np.int32)
    if with_children:
        parents = np.concatenate([parents, _below(sparse_map, free)])
    # Culled ones do not: what has no observations moves with the map, and must not hold it.
    parents = parents[(parents >= 0) & mask[parents] & (keyframes.culled[parents] == 0)]
    rows = np.unique(np.concatenate([free_rows, others, parents]))
    rows = rows[np.argsort(keyframes.id[rows])]
    number = np.full(sparse_map.height, -1, np.int32)
    number[rows] = np.arange(len(rows))
    keep = number[table.row[slots]] >= 0

    # A landmark needs two views to constrain poses.
    seen = np.bincount(which[keep], minlength=len(points))
    keep &= seen[which] >= 2
    points = points[seen >= 2]
    if len(points) < _MIN_LANDMARKS:
        return None
    slots = slots[keep]
    starts = np.concatenate([[0], np.cumsum(seen[seen >= 2])]).astype(np.int32)

    is_free = np.isin(rows, free_rows) & ~np.isin(keyframes.id[rows], np.array(sorted(held), np.int64))
    if is_free.all():
        is_free[0] = False
    if not is_free.any():
        return None
    positions, _ = sparse_map.positions(points)
    measured, sigma = measurements(sparse_map, slots, measurement)
    problem = BundleProblem(
        _inverted(keyframes.T_w_k[rows]), keyframes.camera[rows], is_free, positions, starts,
        number[table.row[slots]], measured, sigma,
    )  # fmt: skip
    return BundleWindow(rows, points, slots, problem)


def _below(sparse_map: SparseMap, keyframes: Sequence[KeyframeId]) -> I32:
    """Rows of the nearest descendants of keyframes that are not culled: without them, all behind would move along."""
    table, open_, out = sparse_map.keyframes, list(keyframes), list[int]()
    while open_:
        rows = sparse_map.children_of(open_.pop())
        open_ += [KeyframeId(int(table.id[row])) for row in rows if table.culled[row]]
        out += [row for row in rows if not table.culled[row]]
    return np.array(out, np.int32)


def measurements(sparse_map: SparseMap, slots: I32, config: MeasurementConfig) -> tuple[F64, F64]:
    """Measurements (m,3) u, v, disparity in px (-1 none); standard deviations (m,2) of pixel and disparity in px."""
    table = sparse_map.keypoints
    rows = table.row[slots]
    has_depth = np.zeros(sparse_map.height, bool)
    sigma = np.full(sparse_map.height, config.sigma_disparity_px)
    here = np.flatnonzero(np.bincount(rows, minlength=1))
    agents = sparse_map.keyframes.id[here] >> (SEQUENCE_BITS + SUBMAP_BITS + BOOT_BITS)
    for agent in map(AgentId, np.unique(agents).tolist()):
        own = here[agents == agent]
        if agent in sparse_map.disparity_calibrated:
            sigma[own] = _SIGMA_CALIBRATED_PX
        has_depth[own] = agent in sparse_map.cameras and sparse_map.measures_distances(agent)
    ranged = (table.inv_depth[slots] > 0) & has_depth[rows]
    measured = np.empty((len(slots), 3))
    measured[:, :2] = table.uv[slots]
    disparity = sparse_map.keyframes.camera[rows, 4] * table.inv_depth[slots] - offsets(sparse_map, slots)
    measured[:, 2] = np.where(ranged, np.maximum(disparity, 0.0), -1.0)
    octave = table.octave[slots].astype(np.float64)
    aligned = _SIGMA_GROWTH**octave
    fused = (table.kind[slots] == LANDMARK) & (table.root[slots] != slots)
    pixel = np.where(fused, _SIGMA_FUSED_PX * _SIGMA_FUSED_GROWTH**octave, config.sigma_px * aligned)
    return measured, np.stack([pixel, sigma[rows] * aligned], 1)


def _inverted(poses: F64) -> F64:
    out = np.zeros_like(poses)
    out[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], poses[:, :3, 3])
    out[:, 3, 3] = 1.0
    return out

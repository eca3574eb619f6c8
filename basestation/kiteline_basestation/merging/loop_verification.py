"""Verifies geometrically that a keyframe shows the same place as an older keyframe.

Descriptors are matched to the landmarks of the older keyframe and of its covisible neighbours, as in ORB-SLAM3
(C. Campos et al., T-RO 2021, section VII-A): one keyframe alone has too few of those that a distant view shows. A
pose by RANSAC and guided matching follow (ORB-SLAM2, section III-E). The matched landmarks must also be spread over the
image and make up most of those expected in view.
"""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_basestation.config import LoopConfig
from kiteline_basestation.map.map_tables import LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.loop_edges import LoopMatch
from kiteline_basestation.merging.similarity import align_views
from kiteline_basestation.refinement.landmark_matching import predict_projections
from kiteline_core.arrays import F64, I32, U8, Bool
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import KeyframeId, agent_of_keyframe, submap_of_keyframe
from kiteline_core.imaging import matching
from kiteline_core.imaging.descriptors import comparable, is_described
from kiteline_core.pose import pnp
from kiteline_core.pose.pose_kernels import optimise_pose

_UNIT_RATIO = 1.15  # of depths in two maps: monocular scale drift stays below it
_NEAREST_M = 0.1  # of a landmark before a camera
_UNIT_POINTS = 8  # with depth in both maps; fewer are not tested
_OCTAVE_GAP = 1.5  # octaves between the predicted and the detected scale
_MIN_SCALE_POINTS = 20  # landmarks with depth in both maps, from which a scale is estimated
_SCALE_SPREAD = 0.2  # of the logarithm of depth ratios; ratios within it agree
_SCALE_SHARE = 0.7  # of the depth ratios that must agree: two different objects fix no scale
_CELL_INLIERS = 2  # inliers that fill a cell
_MIN_CELLS = 8  # filled cells, of 24
_SIGMA_DISPARITY_PX = 0.4  # px; standard deviation of the disparities behind the landmarks' depths
_MIN_INLIERS_ACROSS = 13  # landmarks of two maps that agree before guided matching: by chance up to 10
MAX_NEIGHBOURS = 8  # covisible keyframes whose landmarks are matched too
_SCALE_SIGMA = 0.02  # standard error of the scale's logarithm: the bundle corrects a few percent


@dataclass(frozen=True, slots=True)
class KeyframeObservations:
    """Observations of a keyframe, one row each.

    slots, points: (n,) observations and their root landmarks. uv: (n,2) px. disparity: (n,) px, -1 none. octave, angle:
    (n,). descriptor: (n,32). xyz: (n,3) m in w. known: (n,) True where the landmark has a depth.
    """

    slots: I32
    points: I32
    uv: F64
    disparity: F64
    octave: U8
    angle: U8
    descriptor: U8
    xyz: F64
    known: Bool


def observations_of(sparse_map: SparseMap, keyframe: KeyframeId) -> KeyframeObservations:
    """Observations of a keyframe, with descriptors of the root landmarks rotated to the keyframe's roll."""
    table = sparse_map.keypoints
    row = sparse_map.rows[keyframe]
    slots = sparse_map.observations_of(keyframe)
    points = table.root[slots]
    described_by = np.where(table.kind[slots] == LANDMARK, slots, points)
    angle = _rotated(sparse_map, row, described_by)
    xyz, known = sparse_map.positions(points)
    bf = sparse_map.keyframes.camera[row, 4]
    ranged = (table.inv_depth[slots] > 0) & (bf > 0) & (not sparse_map.is_up_to_scale(submap_of_keyframe(keyframe)))
    measured = np.where(ranged, bf * table.inv_depth[slots].astype(np.float64), -1.0)
    return KeyframeObservations(
        slots, points, table.uv[slots].astype(np.float64), measured, table.octave[slots], angle,
        table.descriptor[described_by], xyz, known,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class LocalLandmarks:
    """Landmarks of a keyframe and its covisible neighbours, described as that keyframe would see them.

    points: (n,) roots with a depth. xyz: (n,3) m in w. angle: (n,). descriptor: (n,32).
    """

    points: I32
    xyz: F64
    angle: U8
    descriptor: U8


def local_landmarks(sparse_map: SparseMap, keyframe: KeyframeId, neighbours: int) -> LocalLandmarks:
    """Landmarks of a keyframe and of its most covisible neighbours, with directions rotated to the keyframe's roll."""
    table = sparse_map.keypoints
    around = [keyframe, *sparse_map.covisible_keyframes(keyframe, 1)[:neighbours]]
    points = sparse_map.sorted_by_id(np.concatenate([sparse_map.landmarks_of(k) for k in around]))
    xyz, known = sparse_map.positions(points)
    known &= is_described(table.descriptor[points])
    points = points[known]
    angle = _rotated(sparse_map, sparse_map.rows[keyframe], points)
    return LocalLandmarks(points, xyz[known], angle, table.descriptor[points])


def verify_loop(
    sparse_map: SparseMap, new: KeyframeId, old: KeyframeId, config: LoopConfig,
    view: KeyframeObservations | None = None, guess: tuple[F64, float] | None = None,
) -> LoopMatch | None:  # fmt: skip
    """Match `new` against `old` and its covisible neighbours; None if the match cannot be verified.

    Poses are taken within the map of each keyframe; the current alignment of the two maps is not used. view: the
    observations of `new`, if already gathered. guess: T_c_w (4,4) of `new` in the old map and the scale of the old over
    the new map, as another keyframe's match implies them; guided matching begins there if RANSAC finds no pose.
    """
    mine = observations_of(sparse_map, new) if view is None else view
    across = sparse_map.map_id(submap_of_keyframe(new)) != sparse_map.map_id(submap_of_keyframe(old))
    theirs = local_landmarks(sparse_map, old, MAX_NEIGHBOURS if across else 0)
    enough = _MIN_INLIERS_ACROSS if across else config.min_inliers  # one map waits for near views: they correct best
    wanted, offered = comparable(mine.descriptor, theirs.descriptor)
    pairs = matching.match(wanted, mine.angle, offered, theirs.angle)
    a, b = pairs.a, pairs.b
    free = any(sparse_map.is_up_to_scale(submap_of_keyframe(k)) for k in (new, old))
    if free:
        mine = replace(mine, disparity=np.full(len(mine.uv), -1.0))  # in another unit than the old map
    start = None
    if len(a) >= enough:
        start = _solve_similarity(sparse_map, new, old, mine, theirs, a, b, enough) if free else None
        start = start or _solve_pnp(sparse_map, new, old, mine, theirs, a, b, enough)
    start = start or guess
    if start is None:
        return None
    observed = np.column_stack([mine.uv, mine.disparity])
    found = _match_neighbours(sparse_map, new, old, mine, observed, start[0], start[1] if free else 1.0, config)
    if found is None:
        return None
    T_c_w, which, points, share = found
    if len(which) < config.min_inliers_all or share < config.min_matched_share:
        return None
    if not spread_out(sparse_map, new, mine.uv[which], config):
        return None
    xyz, _ = sparse_map.positions(points)
    depth = se3.transform(T_c_w, xyz)[:, 2]
    T_old_new = se3.orthonormalise(se3.inverse(sparse_map.keyframes.T_w_k[sparse_map.rows[old]]) @ se3.inverse(T_c_w))
    ids = sparse_map.landmark_ids(mine.points[which]), sparse_map.landmark_ids(points)
    if not free:
        if not same_unit(sparse_map, new, mine, which, depth):
            return None
        return LoopMatch(new, old, T_old_new, len(which), float(np.median(depth)), 1.0, *ids)
    scale = depth_scale(_depths_in_own_map(sparse_map, new, mine, which), depth[mine.known[which]])
    if scale is None:
        return None
    unit_new, unit_old = (float(sparse_map.keyframes.scale[sparse_map.rows[k]]) for k in (new, old))
    return LoopMatch(
        new, old, sim3.with_scaled_translation(T_old_new, 1.0 / unit_old), len(which),
        float(np.median(depth)) / unit_old, scale * unit_new / unit_old, *ids,
    )  # fmt: skip


def guessed_pose(sparse_map: SparseMap, correction: F64, keyframe: KeyframeId) -> tuple[F64, float]:
    """T_c_w (4,4) of a keyframe in another map, and that map's scale over its own.

    correction: (4,4) by another match; it moves the keyframe's map in w onto the other one.
    """
    moved = correction @ sim3.of(1.0, sparse_map.keyframes.T_w_k[sparse_map.rows[keyframe]])
    return se3.inverse(se3.orthonormalise(sim3.rigid(moved))), sim3.scale_of(correction)


def _solve_pnp(
    sparse_map: SparseMap, new: KeyframeId, old: KeyframeId, mine: KeyframeObservations,
    theirs: LocalLandmarks, a: I32, b: I32, enough: int,
) -> tuple[F64, float] | None:  # fmt: skip
    """T_c_w (4,4) of the new camera in the old map by RANSAC PnP, and a rough scale of the old over the new map."""
    rays = _depth_rays(sparse_map, theirs.points, theirs.xyz)
    observed = np.column_stack([mine.uv, mine.disparity])
    camera = sparse_map.keyframes.camera[sparse_map.rows[new]].copy()
    fit = pnp.solve_pnp(theirs.xyz[b], rays[b], observed[a], mine.octave[a], camera, _seed(new, old))
    if fit is None or fit.inliers < enough:
        return None
    a, b = a[fit.inlier], b[fit.inlier]
    other = se3.transform(fit.T_c_m, theirs.xyz[b])[mine.known[a], 2]
    ratio = other / np.maximum(_depths_in_own_map(sparse_map, new, mine, a), 1e-3)
    return fit.T_c_m, float(np.median(ratio)) if len(ratio) else 1.0


def _solve_similarity(
    sparse_map: SparseMap, new: KeyframeId, old: KeyframeId, mine: KeyframeObservations,
    theirs: LocalLandmarks, a: I32, b: I32, enough: int,
) -> tuple[F64, float] | None:  # fmt: skip
    """T_c_w (4,4) of the new camera in the old map, and the scale of the old over the new map.

    Aligns landmarks known in both maps (B. Horn, 1987, in RANSAC, as monocular ORB-SLAM does). None with too few.
    """
    rows = [sparse_map.rows[k] for k in (old, new)]
    T_old, T_new = sparse_map.keyframes.T_w_k[rows]
    lens_old, lens_new = sparse_map.keyframes.camera[rows]
    in_old = se3.transform(se3.inverse(T_old), theirs.xyz)
    both = mine.known[a] & (in_old[b, 2] > _NEAREST_M)
    a, b = a[both], b[both]
    if len(a) < enough:
        return None
    in_old = in_old[b]
    uv_old = in_old[:, :2] / in_old[:, 2:] * lens_old[:2] + lens_old[2:4]  # where `old` sees them, or would
    fit = align_views(
        in_old, uv_old, sparse_map.keypoints.octave[theirs.points[b]], lens_old,
        se3.transform(se3.inverse(T_new), mine.xyz[a]), mine.uv[a], mine.octave[a], lens_new,
        with_scale=True, seed=_seed(new, old),
    )  # fmt: skip
    if fit is None or fit.inliers < enough or not np.isfinite(fit.S_a_b).all():
        return None
    return se3.inverse(se3.orthonormalise(T_old @ sim3.rigid(fit.S_a_b))), fit.scale


def _rotated(sparse_map: SparseMap, row: int, slots: I32) -> U8:
    """Directions (n,) of keypoints as the keyframe of a row would see them, which may be rolled against theirs."""
    table, T = sparse_map.keypoints, sparse_map.keyframes.T_w_k
    turn = np.einsum("ji,njk->nik", T[row, :3, :3], T[table.row[slots], :3, :3])
    roll = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
    angle = (table.angle[slots].astype(np.int64) + np.rint(roll * (128.0 / np.pi)).astype(np.int64)) & 255
    return np.asarray(angle, np.uint8)


def _seed(new: KeyframeId, old: KeyframeId) -> int:
    return int(new) ^ (int(old) << 1)


def _depths_in_own_map(sparse_map: SparseMap, new: KeyframeId, mine: KeyframeObservations, which: I32) -> F64:
    """Depths (k,) in w, in the new camera by its own map, of the rows `which` that have one."""
    xyz = mine.xyz[which[mine.known[which]]]
    return se3.transform(se3.inverse(sparse_map.keyframes.T_w_k[sparse_map.rows[new]]), xyz)[:, 2]


def depth_scale(own: F64, other: F64) -> float | None:
    """Scale of the other map over its own, from depths (n,) of the same points; None if it is too uncertain."""
    if len(own) < _MIN_SCALE_POINTS:
        return None
    ratio = np.log(np.maximum(other, 1e-3) / np.maximum(own, 1e-3))
    middle = float(np.median(ratio))
    apart = np.abs(ratio - middle)
    close = apart < _SCALE_SPREAD
    sigma = 1.2533 * 1.4826 * float(np.median(apart)) / np.sqrt(len(ratio))  # standard error of a median
    if float(np.mean(close)) < _SCALE_SHARE or sigma > _SCALE_SIGMA:
        return None
    return float(np.exp(middle))


def same_unit(sparse_map: SparseMap, new: KeyframeId, mine: KeyframeObservations, which: I32, depth: F64) -> bool:
    """True if both maps have the same unit of length, by depths (k,) m of landmarks observed in both.

    A monocular submap has a unit of its own, which a pose by PnP cannot show.
    """
    known = mine.known[which]
    if np.count_nonzero(known) < _UNIT_POINTS:
        return True
    own = _depths_in_own_map(sparse_map, new, mine, which)
    ratio = float(np.median(depth[known] / np.maximum(own, 1e-3)))
    return 1.0 / _UNIT_RATIO < ratio < _UNIT_RATIO


def spread_out(sparse_map: SparseMap, keyframe: KeyframeId, uv: F64, config: LoopConfig) -> bool:
    """True if pixels (n,2) lie in enough cells of the image: a poster that hangs twice fills few."""
    camera = sparse_map.cameras[agent_of_keyframe(keyframe)]
    column = np.clip(uv[:, 0] * (config.columns / camera.width), 0, config.columns - 1).astype(np.int64)
    row = np.clip(uv[:, 1] * (config.rows / camera.height), 0, config.rows - 1).astype(np.int64)
    filled = np.bincount(row * config.columns + column, minlength=config.rows * config.columns)
    return int(np.count_nonzero(filled >= _CELL_INLIERS)) >= _MIN_CELLS


def _match_neighbours(
    sparse_map: SparseMap, new: KeyframeId, old: KeyframeId, mine: KeyframeObservations,
    observed: F64, T_c_w: F64, scale: float, config: LoopConfig,
) -> tuple[F64, I32, I32, float] | None:  # fmt: skip
    """Match all landmarks of the old keyframe and its neighbours, twice, the second time within half the radius.

    scale: of the old over the new map. Returns the pose, rows of `mine` and landmark slots (k,) that agree, and their
    share of the landmarks expected in view.
    """
    around = [old, *sparse_map.covisible_keyframes(old, 1)[:MAX_NEIGHBOURS]]
    points = sparse_map.sorted_by_id(np.concatenate([sparse_map.landmarks_of(k) for k in around]))
    _, known = sparse_map.positions(points)
    points = points[known & is_described(sparse_map.keypoints.descriptor[points])]
    size = sparse_map.cameras[agent_of_keyframe(new)]
    camera = sparse_map.keyframes.camera[sparse_map.rows[new]].copy()
    T = T_c_w
    for radius in (config.radius_px, 0.5 * config.radius_px):
        seen, uv, octave, _, _ = predict_projections(sparse_map, points, new, se3.inverse(T))
        if len(seen) < config.min_inliers:
            return None
        wanted, offered = comparable(sparse_map.keypoints.descriptor[seen], mine.descriptor)
        near = matching.match_near(
            uv, radius * np.exp2(np.clip(octave, 0.0, 4.0)), octave, wanted, mine.uv, mine.octave,
            offered, (size.width, size.height), _OCTAVE_GAP,
        )  # fmt: skip
        if len(near.a) < config.min_inliers:
            return None
        a, b = near.b, seen[near.a]
        xyz, _ = sparse_map.positions(b)
        inlier = np.ones(len(a), np.bool_)
        T = T.copy()
        sigma = pnp.CORNER_SIGMA_PX * np.ldexp(1.0, mine.octave[a].astype(np.int32))
        optimise_pose(
            T, xyz, _depth_rays(sparse_map, b, xyz), np.ascontiguousarray(observed[a]), sigma, camera, 3, 5,
            pnp.PIXEL_CHI2, inlier,
        )  # fmt: skip
        if not np.isfinite(T).all():
            return None
    first, unique = np.unique(a[inlier], return_index=True)
    share = len(first) / max(1, min(len(seen), _expected_in_view(sparse_map, mine, T, scale, new, around)))
    return T, first.astype(np.int32), np.asarray(b[inlier][unique]), share


def _expected_in_view(
    sparse_map: SparseMap,
    mine: KeyframeObservations,
    T_c_w: F64,
    scale: float,
    new: KeyframeId,
    around: list[KeyframeId],
) -> int:
    """Number of described landmarks of the new keyframe that project into the image of one of the old keyframes."""
    row = sparse_map.rows[new]
    local = se3.transform(se3.inverse(sparse_map.keyframes.T_w_k[row]), mine.xyz)
    xyz = se3.transform(se3.inverse(T_c_w), scale * local)[mine.known & is_described(mine.descriptor)]
    inside = np.zeros(len(xyz), np.bool_)
    for keyframe in around:
        other = sparse_map.rows[keyframe]
        fx, fy, cx, cy, _ = sparse_map.keyframes.camera[other]
        there = se3.transform(se3.inverse(sparse_map.keyframes.T_w_k[other]), xyz)
        z = np.maximum(there[:, 2], 1e-3)
        u, v = fx * there[:, 0] / z + cx, fy * there[:, 1] / z + cy
        size = sparse_map.cameras[agent_of_keyframe(keyframe)]
        inside |= (there[:, 2] > _NEAREST_M) & (u >= 0) & (v >= 0) & (u < size.width) & (v < size.height)
    return int(np.count_nonzero(inside))


def _depth_rays(sparse_map: SparseMap, points: I32, xyz: F64) -> F64:
    """One standard deviation (n,3) m of landmarks along their viewing rays."""
    rows = sparse_map.keypoints.row[points]
    pose = sparse_map.keyframes.T_w_k[rows]
    ray = xyz - pose[:, :3, 3]
    depth = np.maximum(np.einsum("ni,ni->n", pose[:, :3, 2], ray), 1e-3)
    bf = np.maximum(sparse_map.keyframes.camera[rows, 4], 1.0)
    own = depth / sparse_map.keyframes.scale[rows]
    return np.ascontiguousarray(ray * (_SIGMA_DISPARITY_PX * own / bf)[:, None])

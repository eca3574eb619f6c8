"""Adds the agent's relative poses between a keyframe and its parent to a bundle problem.

The agent tracked all frames in between, with an IMU if it has one, and with ten times the landmarks that a thin link
carries. A relative pose is added as synthetic points that both keyframes observe exactly where that pose puts them. For
a keyframe with enough observations these points are far away, so that they constrain only the rotation, which the agent
measures best (0.1 to 0.2 mrad an axis between keyframes). Other keyframes observe points nearby. Those of pairs have a
disparity in one of the two images. It stands for those that the agent measured: with another disparity offset than the
agent had, the same images mean another motion, so that a worn rig's steps follow the offset as it becomes known. While
it is not, it biases rotations all in one direction: the weight decreases where rotations differ, and for rigs that are
known to be worn. A camera that measures no depth sees its points at the median depth of its landmarks, and knows their
distances to a share of them, so that a step counts alike in a room and high above ground. In a submap in metres a
second, weak set holds the agent's lengths, which rest on its IMU, or, where the map's own accelerations have corrected
them, those that the map has there now. In a submap in a unit of its own, which drifts, steps tell lengths by those that
the steps around have in the map, where observations are few. Between keyframes that look different ways the points lie
between their views, off both images. Inertial steps tie the first keyframe of a submap to the last one of the submap
before.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kiteline_basestation.config import OdometryFactorConfig
from kiteline_basestation.inertial.ties import moved_camera
from kiteline_basestation.inertial.units import units_of
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.bundle_window import BundleWindow
from kiteline_core.arrays import F64, I32, Bool
from kiteline_core.geometry import disparity_offset, se3, sim3
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, agent_of_keyframe, agent_of_submap, submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleProblem, BundleResult

_GRID = np.stack(np.meshgrid((-0.6, 0.0, 0.6), (-0.4, 0.4)), -1).reshape(-1, 2)  # x/z, y/z: as wide as a usual lens
_WIDEST = float(np.hypot(*_GRID[0]))  # the farthest of these from the axis
_PX_OF_ROTATION = 1.7  # factor from a rotation's error to the standard deviation of 6 far points, each observed twice
_MIN_RUN = 5  # rotations for an estimate of their common error
_ON_PLANE = np.column_stack([_GRID, np.ones(len(_GRID))])
_DEPTHS = np.concatenate([0.7 * _ON_PLANE, 1.8 * _ON_PLANE])  # of the median depth: near points tell the translation
_FAR = 8.0  # times the median depth: such points tell rotation alone
_ROTATION_DEPTHS = _FAR * _ON_PLANE
_MOST_PX = 1e5  # above any disparity, so that one sort orders by camera and disparity
_UNKNOWN_DEPTH = 3.0  # m; where no depth is known
_VIRTUAL_DISPARITY_PX = 14.0  # px; over it deviations in px are shares of distances, where images measure none
_LEAST_POINTS = 4  # synthetic points of a step
_NO_DISPARITY, _NO_GROUP = -1.0, -1
_ROTATION_SIGMA_PX = 0.1  # px; of each of 6 far synthetic points: together they hold rotation to 0.15 mrad
_SCALE_POINT_PX = 2.0  # px; of each of 12 more in monocular submaps in metres, whose images tell no scale
_SCALE_SIGMA_PX = 1.0  # px; of their virtual disparities, which hold lengths
_WIDE_COS = 0.77  # of the angle between two views beyond which points lie between them: 40 degrees
_STEEPEST_RAD = 1.3  # from an optical axis to such points, where the views leave room for it: 75 degrees
_LEAST_SPREAD = 0.1  # of these points along the turn, as a share of the usual one
_FARTHER = (1.0, 2.0, 4.0, 8.0)  # times as far are such points until both views see all: the camera moved, too
_AHEAD, _WIDE_AHEAD = 0.1, 0.05  # of the median depth: least depth of synthetic points
_USUAL_S = 0.5  # s of a usual step; over longer ones the agent drifts by more
_RUN = 20  # keyframes; consecutive rotations whose common error is estimated together


class _Step(NamedTuple):
    """Synthetic points of the step from keyframe p of a window to k.

    in_k, in_p: (n,3) where both see them; sigma_k, sigma_p: (n,2) px deviations of pixel and disparity; terms: (n,5) of
    the disparity offset in k, zero where it does not count; world: (n,3) positions.
    """

    k: int
    p: int
    in_k: F64
    in_p: F64
    sigma_k: F64
    sigma_p: F64
    terms: F64
    world: F64


def with_odometry_factors(sparse_map: SparseMap, window: BundleWindow, config: OdometryFactorConfig) -> BundleProblem:
    """The window's problem with odometry factors, stronger where observations are few; synthetic points last."""
    problem = window.problem
    points, camera, measured, sigma, group, terms = [], [], [], [], [], []
    border, of_camera = problem.border, _groups(problem)
    for step in _steps(sparse_map, window, config, of_camera):
        points.append(step.world)
        k = step.k, step.in_k, step.sigma_k, of_camera[step.k]
        p = step.p, step.in_p, step.sigma_p, _NO_GROUP
        (first, in_first, sigma_first, of_first), (second, in_second, sigma_second, of_second) = sorted(
            (k, p), key=lambda seen: seen[0]
        )
        n = len(step.world)
        camera += [first, second] * n
        measured.append(np.concatenate([in_first, in_second], axis=1).reshape(2 * n, 3))
        sigma.append(np.concatenate([sigma_first, sigma_second], axis=1).reshape(2 * n, 2))
        group += [of_first, of_second] * n
        terms.append(np.repeat(step.terms, 2, axis=0))
    if not points:
        return problem
    added = np.concatenate(points)
    if border is not None:
        groups = np.where(np.any(own := np.concatenate(terms), axis=1), group, _NO_GROUP).astype(np.int32)
        border = replace(
            border, group=np.concatenate([border.group, groups]), terms=np.concatenate([border.terms, own])
        )
    return replace(
        problem,
        points=np.concatenate([problem.points, added]),
        starts=np.concatenate(
            [problem.starts, problem.starts[-1] + 2 * np.arange(1, len(added) + 1, dtype=np.int32)]
        ).astype(np.int32),
        camera=np.concatenate([problem.camera, np.array(camera, np.int32)]),
        measured=np.concatenate([problem.measured, *measured]),
        sigma=np.concatenate([problem.sigma, *sigma]),
        border=border,
    )


def _steps(
    sparse_map: SparseMap, window: BundleWindow, config: OdometryFactorConfig, of_camera: I32
) -> Iterator[_Step]:
    """The steps between keyframes of a window. of_camera: see `_groups`."""
    problem, table = window.problem, sparse_map.keyframes
    counts = np.bincount(problem.camera, minlength=len(window.rows))
    number = {int(table.id[row]): i for i, row in enumerate(window.rows.tolist())}
    difference_px = _PX_OF_ROTATION * _rotation_difference_px(sparse_map, window, number, _RUN)
    unranged = np.array([not sparse_map.is_ranged(submap_of_keyframe(KeyframeId(k))) for k in number], np.bool_)
    depth, units = median_depths(problem, unranged), units_of(sparse_map, window.rows, _RUN)
    for k, row in enumerate(window.rows.tolist()):
        keyframe = KeyframeId(int(table.id[row]))
        if agent_of_keyframe(keyframe) not in sparse_map.cameras:
            continue  # its agent has yet to send it
        p, T_p_k = number.get(int(table.parent[row])), table.T_p_k[row]
        if p is None and (tie := sparse_map.inertial_steps.get(keyframe)) is not None:
            p, T_p_k = number.get(tie.since), moved_camera(sparse_map, tie)
        agent, submap = agent_of_keyframe(keyframe), submap_of_keyframe(keyframe)
        if np.isnan(depth[k]):
            depth[k] = depth[p] if unranged[k] and p is not None and depth[p] > 0.0 else _UNKNOWN_DEPTH
        if p is None or not (problem.free[k] or problem.free[p]):
            continue
        gap_s = abs(float(table.t_ns[row] - table.t_ns[window.rows[p]])) * 1e-9
        few = max(0.0, 1.0 - min(counts[k], counts[p]) / config.enough_observations)
        sets = _point_sets(sparse_map, submap, config, few, gap_s, difference_px)
        own = submap_of_keyframe(KeyframeId(int(table.id[window.rows[p]]))) == submap
        T_p_k = sim3.with_scaled_translation(T_p_k, float(units[k] if own else units[p]))
        for depths, point_px, disparity_px in sets:
            step = _synthetic_points(problem, k, p, T_p_k, depths, float(depth[k]), point_px)
            if step is None:
                continue
            if unranged[k]:
                step = _by_distance(step, disparity_px / _VIRTUAL_DISPARITY_PX)
            elif depths is _DEPTHS and not _is_wide(T_p_k):
                change_px = sparse_map.offset_measured_with(keyframe) - _assumed(sparse_map, agent, of_camera[k])
                step = _following_offset(problem.lens[k], step, change_px)
            yield step


def _point_sets(
    sparse_map: SparseMap, submap: SubmapId, config: OdometryFactorConfig, few: float, gap_s: float,
    difference_px: float,
) -> list[tuple[F64, float, float]]:  # fmt: skip
    """Shapes (n,3) of a step's synthetic points at a median depth of one, with the deviations of pixel and disparity.

    These are in px, of disparities that images do not measure at `_VIRTUAL_DISPARITY_PX`. few: from 0, where
    observations are enough, to 1 without any. gap_s: of the step. difference_px: of rotations.
    """
    agent, longer = agent_of_submap(submap), np.sqrt(max(1.0, gap_s / _USUAL_S))
    if sparse_map.is_up_to_scale(submap):  # where observations are many, these tell more of its drift than steps do
        point_px = max(longer * config.sigma_px, difference_px)
        return [(_DEPTHS, point_px / few, config.sigma_px / few)] if few > 0.0 else []
    worn_px = config.worn_px * np.sqrt(gap_s) if agent in sparse_map.disparity_sigma_px else 0.0
    rotation_px = max(_ROTATION_SIGMA_PX, worn_px, difference_px)
    point_px = 1.0 / np.hypot(few / max(longer * config.sigma_px, worn_px), 1.0 / rotation_px)
    sets = [(_DEPTHS, point_px, point_px) if few > 0.0 else (_ROTATION_DEPTHS, point_px, _FAR * point_px)]
    if not sparse_map.measures_distances(agent):
        sets.append((_DEPTHS, _SCALE_POINT_PX, _SCALE_SIGMA_PX))
    return sets


def _by_distance(step: _Step, share: float) -> _Step:
    """A step of a camera that measures no distances: those of its points are known to a share of themselves."""
    return step._replace(
        sigma_k=np.column_stack([step.sigma_k[:, 0], share * step.in_k[:, 2]]),
        sigma_p=np.column_stack([step.sigma_p[:, 0], share * step.in_p[:, 2]]),
    )


def _following_offset(lens: F64, step: _Step, change_px: F64) -> _Step:
    """A step whose disparities follow an offset that changed by change_px (5,): in k alone, where one is left.

    If too few are, in scenes so far away, the step as it was told.
    """
    terms = disparity_offset.terms((step.in_k[:, :2] - lens[2:4]) / lens[:2])
    disparity = step.in_k[:, 2] + terms @ change_px
    seen = disparity > 0.0
    if np.count_nonzero(seen) < _LEAST_POINTS:
        return step
    in_k = np.column_stack([step.in_k[seen, :2], disparity[seen]])
    in_p = np.column_stack([step.in_p[seen, :2], np.full(len(in_k), _NO_DISPARITY)])
    return step._replace(
        in_k=in_k, in_p=in_p, sigma_k=step.sigma_k[seen], sigma_p=step.sigma_p[seen], terms=terms[seen],
        world=step.world[seen],
    )  # fmt: skip


def _groups(problem: BundleProblem) -> I32:
    """Group (k,) of each camera in the problem's border; none where its disparities are taken as corrected."""
    out = np.full(len(problem.T_c_m), _NO_GROUP, np.int32)
    if problem.border is not None:
        np.maximum.at(out, problem.camera, problem.border.group)
    return out


def _assumed(sparse_map: SparseMap, agent: AgentId, group: int) -> F64:
    """Disparity offset (5,) px that a problem's disparities are corrected for: none where it is estimated."""
    known = sparse_map.disparity_offset_px.get(agent)
    return disparity_offset.none() if known is None or group != _NO_GROUP else known


def _rotation_difference_px(sparse_map: SparseMap, window: BundleWindow, number: dict[int, int], run: int) -> float:
    """Difference of the window's relative rotations to the agents', per axis in px at the focal length.

    The median, or the mean error common to runs of consecutive rotations if that is larger.
    """
    table, T = sparse_map.keyframes, window.problem.T_c_m
    parents = [number.get(int(p), -1) for p in table.parent[window.rows].tolist()]
    pairs = [(k, p) for k, p in enumerate(parents) if p >= 0]
    if not pairs:
        return 0.0
    k, p = np.array(pairs).T
    rotation = T[p, :3, :3] @ np.swapaxes(T[k, :3, :3], 1, 2)
    error = np.swapaxes(table.T_p_k[window.rows[k], :3, :3], 1, 2) @ rotation
    angle = 0.5 * np.stack(
        [error[:, 2, 1] - error[:, 1, 2], error[:, 0, 2] - error[:, 2, 0], error[:, 1, 0] - error[:, 0, 1]], 1
    )
    each = float(np.median(np.linalg.norm(angle, axis=1)) / np.sqrt(3.0))
    n = min(run, len(angle))
    summed = np.cumsum(np.concatenate([np.zeros((1, 3)), angle]), axis=0)
    together = float(np.sqrt(np.mean((summed[n:] - summed[:-n]) ** 2) / n))
    if n < _MIN_RUN:
        together = 0.0
    return max(each, together) * float(np.median(window.problem.lens[k, 0]))


def median_depths(problem: BundleProblem, unranged: Bool) -> F64:
    """The median depth (k,) that each camera observes: by its disparities, or as the map has it if it is `unranged`
    (k,), which measures none. nan without any.
    """
    camera, disparity = problem.camera, problem.measured[:, 2]
    seen = disparity > 0.0
    if unranged.any():
        point, T = problem.points[np.repeat(np.arange(len(problem.points)), np.diff(problem.starts))], problem.T_c_m
        z = np.einsum("nj,nj->n", T[camera, 2, :3], point) + T[camera, 2, 3]
        ahead = unranged[camera] & (z > 0.0)
        disparity = np.divide(problem.lens[camera, 4], z, out=disparity.copy(), where=ahead)
        seen = seen | ahead
    camera, disparity = camera[seen], disparity[seen]
    disparity = np.sort(camera * _MOST_PX + disparity) - np.sort(camera) * _MOST_PX  # by camera, then by disparity
    count = np.bincount(camera, minlength=len(problem.T_c_m))
    known = count > 0
    start = np.cumsum(count)[known] - count[known]
    middle = 0.5 * (disparity[start + (count[known] - 1) // 2] + disparity[start + count[known] // 2])
    depth = np.full(len(count), np.nan)
    depth[known] = problem.lens[known, 4] / middle
    return depth


def _synthetic_points(
    problem: BundleProblem, k: int, p: int, T_p_k: F64, depths: F64, typical: float, sigma_px: float
) -> _Step | None:
    """The step from keyframe p to k; None if both see too few points. depths: (n,3) in k at a `typical` one of 1."""
    wide = _is_wide(T_p_k)
    shape = _between_views(depths, T_p_k) if wide else depths
    for farther in _FARTHER if wide else (1.0,):
        local = farther * typical * shape
        in_parent = se3.transform(T_p_k, local)
        ahead = np.minimum(in_parent[:, 2], local[:, 2]) > (_WIDE_AHEAD if wide else _AHEAD) * typical
        if ahead.all():
            break
    if np.count_nonzero(ahead) < _LEAST_POINTS:
        return None
    local, in_parent = local[ahead], in_parent[ahead]
    world = se3.transform(se3.inverse(problem.T_c_m[k]), local)
    sigma, terms = np.full((len(local), 2), sigma_px), np.zeros((len(local), disparity_offset.TERMS))
    in_k, in_p = _projected(problem.lens[k], local), _projected(problem.lens[p], in_parent)
    step = _Step(k, p, in_k, in_p, sigma, sigma, terms, world)
    return _by_angle(problem, step) if wide else step


def _is_wide(T_p_k: F64) -> bool:
    """True if two keyframes look so different ways that what is ahead of one may be behind the other."""
    return float(T_p_k[2, 2]) < _WIDE_COS


def _between_views(points: F64, T_p_k: F64) -> F64:
    """Points (n,3) that lie before a view, turned to the middle between the views of k and p, in k.

    The farther these are apart, the narrower the points are in the direction of the turn, so that both see them.
    """
    turn = T_p_k[2, :2] / max(float(np.linalg.norm(T_p_k[2, :2])), 1e-9)  # where p looks, seen from k
    half_rad = 0.5 * float(np.arccos(np.clip(T_p_k[2, 2], -1.0, 1.0)))
    spread = np.clip(np.tan(_STEEPEST_RAD - half_rad) / _WIDEST, _LEAST_SPREAD, 1.0)
    narrow = points.copy()
    narrow[:, :2] -= (1.0 - spread) * np.outer(points[:, :2] @ turn, turn)
    return np.asarray(narrow @ se3.so3_exp(half_rad * np.array([-turn[1], turn[0], 0.0])).T)


def _by_angle(problem: BundleProblem, step: _Step) -> _Step:
    """A step whose deviations are angles and shares of distances: off an image's centre these cover more pixels."""
    of_k, of_p = (
        1.0 + np.square((seen[:, :2] - problem.lens[i, 2:4]) / problem.lens[i, :2]).sum(axis=1)
        for i, seen in ((step.k, step.in_k), (step.p, step.in_p))
    )
    return step._replace(
        sigma_k=step.sigma_k * np.stack([of_k, np.sqrt(of_k)], axis=1),
        sigma_p=step.sigma_p * np.stack([of_p, np.sqrt(of_p)], axis=1),
    )


def _projected(lens: F64, xyz: F64) -> F64:
    """u, v, disparity (n,3) px of points (n,3) in the camera frame."""
    inv = 1.0 / xyz[:, 2]
    out = np.empty_like(xyz)
    out[:, 0] = lens[0] * xyz[:, 0] * inv + lens[2]
    out[:, 1] = lens[1] * xyz[:, 1] * inv + lens[3]
    out[:, 2] = lens[4] * inv
    return out


def without_odometry_factors(window: BundleWindow, result: BundleResult) -> BundleResult:
    """The result without the synthetic points."""
    return replace(result, points=result.points[: len(window.points)], inlier=result.inlier[: len(window.slots)])

"""The agents' inertial steps along the keyframes of a map, and the path of the body that poses and steps give."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from kiteline_basestation.inertial.ties import body_poses, moved
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import InertialSteps
from kiteline_core.arrays import F64, I32, I64, Bool
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId, agent_of_keyframe, submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleProblem

_MAX_STEPS = 8000  # of a map, the newest: twenty minutes
_LEAST_M = 0.05  # distance between keyframes from which the path's length follows theirs
_FOLLOW = (0.7, 1.4)  # factors by which it may


@dataclass(frozen=True, slots=True)
class Segment:
    """Steps between keyframes `first` and `last` of a window, which number its poses.

    T_c_b: (4,4). depth_m: median distance of what the camera sees. metre: metres in a unit of the agent's map, as told.
    """

    first: int
    last: int
    T_c_b: F64
    depth_m: float
    metre: float
    steps: InertialSteps


@dataclass(frozen=True, slots=True)
class MapPath:
    """Steps (n,) of all segments between nodes: step i leads from node `begin[i]` to the next one.

    R_w_b: (k,3,3) and camera: (k,3) m, at the nodes, lever: (k,3) m from body to camera, in w. fresh: (k,) True where
    a chain begins. by_bias: (n,2,3,3) what a bias of the accelerometer, which turns with the body, adds to velocity and
    position. noise, depth_m: (n,) of each step's segment.
    """

    begin: I64
    R_w_b: F64
    camera: F64
    lever: F64
    fresh: Bool
    dt_s: F64
    velocity: F64
    position: F64
    by_bias: F64
    noise: F64
    depth_m: F64


def segments_of(sparse_map: SparseMap, rows: I32, problem: BundleProblem) -> tuple[Segment, ...]:
    """Segments of a bundle of the keyframes in `rows` (k,), by agent and time; steps over culled ones are joined."""
    table = sparse_map.keyframes
    number = {int(table.id[row]): i for i, row in enumerate(rows.tolist())}
    depth: F64 | None = None  # where any segment needs it
    out: list[Segment] = []
    for keyframe, i in number.items():
        agent = agent_of_keyframe(KeyframeId(keyframe))
        if not sparse_map.has_metric_scale_by_imu(submap_of_keyframe(KeyframeId(keyframe))):
            continue
        records: list[InertialSteps] = []
        at = KeyframeId(keyframe)
        while (record := sparse_map.inertial_steps.get(at)) is not None and (not records or at not in number):
            records.append(record)
            at = record.since
        if not records or at not in number:
            continue
        records.reverse()
        fields: dict[str, Any] = {name: np.concatenate([getattr(r, name) for r in records]) for name in _STEPS}
        submap = submap_of_keyframe(KeyframeId(keyframe))
        depth = _depths(problem) if depth is None else depth
        out.append(
            Segment(
                number[at], i, se3.inverse(sparse_map.cameras[agent].T_b_c), float(depth[i]),
                sparse_map.metres_per_unit.get(submap, 1.0),
                replace(records[-1], since=at, **fields),
            )
        )  # fmt: skip
    out.sort(key=lambda s: int(table.t_ns[rows[s.last]]))
    kept, n = len(out), 0
    while kept > 0 and n + len(out[kept - 1].steps.dt_s) <= _MAX_STEPS:
        kept, n = kept - 1, n + len(out[kept - 1].steps.dt_s)
    return tuple(sorted(out[kept:], key=lambda s: agent_of_keyframe(s.steps.keyframe)))  # one path after the other


_STEPS = ("dt_s", "turn", "moved", "velocity", "position")


def _depths(problem: BundleProblem) -> F64:
    """Median distance (k,) of the landmarks that each keyframe of a bundle observes; 1 without any."""
    point = np.repeat(np.arange(len(problem.starts) - 1), np.diff(problem.starts))
    T = problem.T_c_m[problem.camera]
    distance = np.linalg.norm(np.einsum("mij,mj->mi", T[:, :3, :3], problem.points[point]) + T[:, :3, 3], axis=1)
    order = np.argsort(problem.camera, kind="stable")
    ends = np.searchsorted(problem.camera[order], np.arange(len(problem.T_c_m) + 1))
    parts = [distance[order[a:b]] for a, b in pairwise(ends)]
    return np.array([float(np.median(part)) if len(part) else 1.0 for part in parts])


def path_along(segments: tuple[Segment, ...], T_w_c: F64) -> MapPath:
    """The path through keyframes at T_w_c (k,4,4).

    Between them it has the shape that the agent saw, bent so that it ends where the keyframes are.
    """
    begin, fresh = list[I64](), list[Bool]()
    R, camera, lever = list[F64](), list[F64](), list[F64]()
    end = -1  # keyframe at which the path ends so far
    for s in segments:
        R_k, p_k = _shape(s, T_w_c[s.first], T_w_c[s.last])
        R_w_b = R_k @ s.T_c_b[:3, :3]
        joined = s.first == end
        drop = 1 if joined else 0  # its first node is the last one of the segment before
        begin.append(sum(map(len, R)) - drop + np.arange(len(s.steps.dt_s)))
        R.append(R_w_b[drop:])
        camera.append(p_k[drop:])
        lever.append(-(R_k @ s.T_c_b[:3, 3])[drop:])
        fresh.append((np.arange(len(R_k)) == 0)[drop:])
        end = s.last
    sizes = [len(s.steps.dt_s) for s in segments]
    dt_s, velocity, position = (np.concatenate([getattr(s.steps, name) for s in segments]) for name in _BY_IMU)
    of_segment = zip(*((s.steps.noise, s.depth_m) for s in segments), strict=True)
    noise, depth_m = (np.repeat(values, sizes) for values in of_segment)
    return MapPath(
        np.concatenate(begin), np.concatenate(R), np.concatenate(camera), np.concatenate(lever),
        np.concatenate(fresh), dt_s, velocity, position, np.concatenate([_by_bias(s) for s in segments]), noise,
        depth_m,
    )  # fmt: skip


_BY_IMU = ("dt_s", "velocity", "position")


def told_units(segments: tuple[Segment, ...], T_w_c: F64) -> float:
    """Units of w in a metre by what the agents told: the lengths between keyframes T_w_c (k,4,4) over the told ones."""
    here = told = 0.0
    for s in segments:
        told += s.metre * float(np.linalg.norm((s.T_c_b @ moved(s.steps) @ se3.inverse(s.T_c_b))[:3, 3]))
        here += float(np.linalg.norm(T_w_c[s.last, :3, 3] - T_w_c[s.first, :3, 3]))
    return here / told if min(here, told) > 0.0 else 1.0


def _by_bias(s: Segment) -> F64:
    """(n,2,3,3), with the body's mean attitude during each step."""
    return np.array(
        [
            [dt * se3.so3_exp(0.5 * turn), 0.5 * dt * dt * se3.so3_exp(turn / 3.0)]
            for dt, turn in zip(s.steps.dt_s.tolist(), s.steps.turn, strict=True)
        ]
    )


def _shape(s: Segment, T_w_first: F64, T_w_last: F64) -> tuple[F64, F64]:
    """Rotations (n+1,3,3) and positions (n+1,3) of the camera in w."""
    T_b_c = se3.inverse(s.T_c_b)
    chain = np.array([np.eye(4), *(s.T_c_b @ T @ T_b_c for T in body_poses(s.steps)[1:])])
    target = se3.inverse(T_w_first) @ T_w_last
    share = np.concatenate([[0.0], np.cumsum(s.steps.dt_s)]) / float(np.sum(s.steps.dt_s))
    apart, seen = float(np.linalg.norm(target[:3, 3])), float(np.linalg.norm(chain[-1, :3, 3]))
    ratio = apart / seen if min(apart, seen) > _LEAST_M else 1.0
    ratio = ratio if _FOLLOW[0] < ratio < _FOLLOW[1] else 1.0
    place = ratio * chain[:, :3, 3] + share[:, None] * (target[:3, 3] - ratio * chain[-1, :3, 3])
    bend = se3.so3_log(chain[-1, :3, :3].T @ target[:3, :3])
    rotation = np.array([C[:3, :3] @ se3.so3_exp(a * bend) for C, a in zip(chain, share, strict=True)])
    R = T_w_first[:3, :3] @ rotation
    return R, T_w_first[:3, 3] + place @ T_w_first[:3, :3].T

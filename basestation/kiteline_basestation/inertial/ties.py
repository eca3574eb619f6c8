"""Inertial ties: relative poses of two submaps between which inertial steps lead without a break.

A monocular agent begins such a submap to correct its scale. The steps from the last keyframe of the old submap to the
first one of the new submap give the relative pose, the agent's record the scale; images need not recognise anything.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from kiteline_basestation.inertial.units import units_of
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import InertialSteps
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import SubmapId, agent_of_keyframe, submap_of_keyframe

_RUN = 20  # keyframes before a tie whose steps tell how long the agent's unit is there


@dataclass(frozen=True, slots=True)
class InertialTie:
    """How two maps lie to each other.

    S_older_newer: (4,4) moves the newer map in w. metre: factor by which the older map is scaled in w before.
    """

    newer: SubmapId
    older: SubmapId
    S_older_newer: F64
    metre: float


class InertialTies:
    """Inertial steps that lead from one submap to another one, until both of their keyframes are in the map."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self._map = sparse_map
        self._waiting: list[InertialSteps] = []

    def add(self, record: InertialSteps) -> None:
        """Keep a record if it leads to another submap."""
        if submap_of_keyframe(record.since) != submap_of_keyframe(record.keyframe):
            self._waiting.append(record)

    def clear(self) -> None:
        """Drop the records that are kept."""
        self._waiting.clear()

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Drop the records that lead from or to deleted submaps."""
        self._waiting = [
            r for r in self._waiting if not {submap_of_keyframe(r.since), submap_of_keyframe(r.keyframe)} & set(submaps)
        ]

    def take(self) -> InertialTie | None:
        """The next tie between two maps; one that joins nothing is dropped."""
        for record in list(self._waiting):
            has_camera = agent_of_keyframe(record.keyframe) in self._map.cameras
            if has_camera and record.keyframe in self._map and record.since in self._map:
                self._waiting.remove(record)
                tie = self._tie(record)
                if tie is not None:
                    return tie
        return None

    def _tie(self, record: InertialSteps) -> InertialTie | None:
        sparse_map = self._map
        before, after = submap_of_keyframe(record.since), submap_of_keyframe(record.keyframe)
        T_w_a, T_w_k = sparse_map.world_pose(record.since), sparse_map.world_pose(record.keyframe)
        older, newer = sparse_map.map_id(before), sparse_map.map_id(after)
        known = all(sparse_map.has_metric_scale_by_imu(s) for s in (before, after, older, newer))
        if T_w_a is None or T_w_k is None or not known or older == newer:
            return None
        # Where the older map was never scaled by the base, the agent's new metre replaces its old one.
        unit = sparse_map.metres_per_unit.get(before, 1.0)
        scaled = before in sparse_map.scaled_submaps or sparse_map.scale(before) != 1.0
        metre = 1.0 if scaled else unit
        keyframes = [k for k in sparse_map.submaps[before] if k <= record.since and sparse_map.pose(k) is not None]
        rows = np.array([sparse_map.rows[k] for k in keyframes[-_RUN:]], np.int32)
        held = float(units_of(sparse_map, rows, _RUN)[-1])
        T_a_k = sim3.with_scaled_translation(moved_camera(sparse_map, record), held)
        S_older_newer = sim3.of(held / unit / sparse_map.scale(after), T_w_a @ T_a_k) @ se3.inverse(T_w_k)
        if newer < older:
            return InertialTie(older, newer, sim3.inverse(S_older_newer), 1.0)
        return InertialTie(newer, older, sim3.normalise(S_older_newer), metre)


def moved_camera(sparse_map: SparseMap, record: InertialSteps) -> F64:
    """Motion (4,4) of the camera along the steps, in the unit of the submap in which they began."""
    T_b_c = sparse_map.cameras[agent_of_keyframe(record.keyframe)].T_b_c
    return np.asarray(se3.inverse(T_b_c) @ moved(record) @ T_b_c)


def moved(record: InertialSteps) -> F64:
    """Motion (4,4) of the body along the steps, as the images saw it."""
    return se3.orthonormalise(body_poses(record)[-1])


def body_poses(record: InertialSteps) -> list[F64]:
    """Poses (4,4) of the body before and after each step, in the first one, as the images saw them."""
    poses = [np.eye(4)]
    for turn, step in zip(record.turn, record.moved, strict=True):
        poses.append(poses[-1] @ se3.from_rt(se3.so3_exp(turn), step))
    return poses

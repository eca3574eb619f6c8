"""The placed part of the map in w: input of exports and of the status page."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.arrays import F64, I32, I64, Bool
from kiteline_core.geometry import sim3
from kiteline_core.ids import KEYPOINT_BITS, SEQUENCE_BITS, SubmapId


@dataclass(frozen=True, slots=True)
class PlacedMap:
    """Keyframes and landmarks of placed submaps in w.

    keyframes: (n,) ids of the rows of positions. landmark_ids: (m,). observations: (k,2) rows of positions
    and of points.
    metric: (n,) True for keyframes of maps of known metric scale.
    """

    keyframes: I64
    positions: F64
    landmark_ids: I64
    points: F64
    observations: I64
    metric: Bool

    @property
    def rays(self) -> I64:
        """Observations in maps of known metric scale: rays for the grid."""
        return self.observations[self.metric[self.observations[:, 0]]]


def placed_map(sparse_map: SparseMap, placements: Mapping[SubmapId, F64]) -> PlacedMap:
    """Keyframes, landmarks with two observations or more, and their observations, of all placed submaps."""
    rows, positions, metric = [], [], []
    for submap in sorted(placements):
        S_w_m, metres = placements[submap], not sparse_map.is_up_to_scale(sparse_map.map_id(submap))
        for keyframe in sparse_map.submaps.get(submap, []):
            pose = sparse_map.pose(keyframe)
            if pose is not None:
                rows.append(sparse_map.rows[keyframe])
                positions.append((S_w_m @ pose)[:3, 3])
                metric.append(metres)
    number = np.full(sparse_map.height, -1, np.int64)
    number[rows] = np.arange(len(rows))
    landmarks, points, starts, slots = _in_world(sparse_map, placements, sparse_map.live_landmarks())
    which = np.repeat(np.arange(len(landmarks)), np.diff(starts))
    observer = number[sparse_map.keypoints.row[slots]]
    pairs = np.stack([observer, which], 1)[observer >= 0]
    return PlacedMap(
        sparse_map.keyframes.id[rows].copy(),
        np.array(positions).reshape(-1, 3),
        sparse_map.landmark_ids(landmarks),
        points,
        pairs,
        np.array(metric, np.bool_),
    )


def some_landmarks(sparse_map: SparseMap, placements: Mapping[SubmapId, F64], most: int) -> tuple[I32, F64]:
    """Slots (m,) and positions in w (m,3) of landmarks with two observations or more in placed submaps.

    At most `most` keypoints of the whole map, evenly chosen, are looked at: it may hold millions.
    """
    slots = np.arange(0, sparse_map.slots, max(1, -(-sparse_map.slots // most)), dtype=np.int32)
    slots = sparse_map.sorted_by_id(slots[sparse_map.is_live(slots)])
    landmarks, points, _, _ = _in_world(sparse_map, placements, slots)
    return landmarks, points


def _in_world(sparse_map: SparseMap, placements: Mapping[SubmapId, F64], landmarks: I32) -> tuple[I32, F64, I32, I32]:
    """Those of root landmarks (n,) in placed submaps that have a position and two observations or more.

    Returns their slots (m,), positions in w (m,3), and observations as `SparseMap.observations` does: starts, slots.
    """
    submap = sparse_map.landmark_ids(landmarks) >> (SEQUENCE_BITS + KEYPOINT_BITS)
    placed = np.isin(submap, sorted(placements))
    landmarks, submap = landmarks[placed], submap[placed]
    xyz, known = sparse_map.positions(landmarks)
    starts, _ = sparse_map.observations(landmarks)
    known &= np.diff(starts) >= 2
    landmarks, submap, xyz = landmarks[known], submap[known], xyz[known]
    for one in map(SubmapId, np.unique(submap).tolist()):
        inside = submap == one
        T = placements[one] @ sim3.inverse(sparse_map.submap_pose(one))
        xyz[inside] = xyz[inside] @ T[:3, :3].T + T[:3, 3]
    return landmarks, xyz, *sparse_map.observations(landmarks)

"""Whether what an agent sent of a keyframe agrees with older keyframes: who makes things up cannot fill the memory."""

import numpy as np

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.ids import KeyframeId

_LEAST_Z = 0.1  # in the submap's unit; a landmark nearer to the camera projects anywhere
_CONFIRMED_PX = 5.0  # px; from the projection of an older landmark to where a keyframe observes it, at most
_MIN_CONFIRMED = 10  # such landmarks, with which a keyframe is of use and its agent may claim memory for another


def is_confirmed(sparse_map: SparseMap, keyframe: KeyframeId) -> bool:
    """True if enough landmarks of other keyframes are where this one observes them."""
    table, row = sparse_map.keypoints, sparse_map.rows[keyframe]
    mine = sparse_map.observations_of(keyframe)
    mine = mine[table.row[table.root[mine]] != row]
    xyz, known = sparse_map.positions(table.root[mine])
    T_w_k = sparse_map.keyframes.T_w_k[row]
    local = (xyz - T_w_k[:3, 3]) @ T_w_k[:3, :3]
    known &= local[:, 2] > _LEAST_Z
    fx, fy, cx, cy = sparse_map.keyframes.camera[row, :4]
    z = np.where(known, local[:, 2], 1.0)
    error = np.stack([fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy], 1) - table.uv[mine]
    near = known & (np.hypot(error[:, 0], error[:, 1]) <= _CONFIRMED_PX)
    return int(np.count_nonzero(near)) >= _MIN_CONFIRMED

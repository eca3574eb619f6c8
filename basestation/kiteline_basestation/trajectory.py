"""Every tracked frame in its refined place: the agent's pose relative to a keyframe, on the base's keyframes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_core import se3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId, submap_of_keyframe
from kiteline_core.sparse_map import SparseMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class FrameRows:
    """An agent's tracked frames, in order of time.

    t_ns: (n,) int64. keyframe: (n,) int64 ids of reference keyframes. T_k_c: (n,4,4) camera in the keyframe.
    """

    t_ns: I64
    keyframe: I64
    T_k_c: F64


def compose(
    sparse_map: SparseMap, rows: FrameRows, placements: Mapping[SubmapId, F64] | None = None, T_b_c: F64 | None = None
) -> tuple[I64, F64]:
    """Times (m,) and body poses T_w_b (m,4,4) of all frames whose keyframe has a pose.

    placements: T_w_m of each submap; frames of other submaps are left out. Without it poses are in their own m.
    T_b_c: (4,4) camera in the body; without it poses are the camera's.

    Where the base moved the keyframe that follows, a frame between the two takes on its share of that correction, so
    that the path has no step where the reference changes.
    """
    T_c_b = np.eye(4) if T_b_c is None else se3.inverse(T_b_c)
    bends: dict[KeyframeId, tuple[int, int, F64] | None] = {}
    children = _children(sparse_map)
    times, poses = [], []
    for t_ns, keyframe, T_k_c in zip(rows.t_ns.tolist(), map(KeyframeId, rows.keyframe.tolist()), rows.T_k_c):
        T_m_k = sparse_map.pose(keyframe)
        T_w_m = np.eye(4) if placements is None else placements.get(submap_of_keyframe(keyframe))
        if T_m_k is None or T_w_m is None:
            continue
        if keyframe not in bends:
            bends[keyframe] = _bend(sparse_map, keyframe, children.get(keyframe))
        bend = bends[keyframe]
        local = T_k_c
        if bend is not None and bend[0] < t_ns <= bend[1]:
            local = se3.exp((t_ns - bend[0]) / (bend[1] - bend[0]) * bend[2]) @ T_k_c
        times.append(t_ns)
        poses.append(T_w_m @ T_m_k @ local @ T_c_b)
    return np.array(times, np.int64), np.array(poses).reshape(-1, 4, 4)


def _children(sparse_map: SparseMap) -> dict[KeyframeId, KeyframeId]:
    """The first keyframe that was measured from each keyframe."""
    out: dict[KeyframeId, KeyframeId] = {}
    for submap in sorted(sparse_map.submaps):
        for keyframe in sparse_map.submaps[submap]:
            parent = KeyframeId(int(sparse_map.keyframes.parent[sparse_map.rows[keyframe]]))
            if parent != NO_KEYFRAME:
                out.setdefault(parent, keyframe)
    return out


def _bend(
    sparse_map: SparseMap, keyframe: KeyframeId, child: KeyframeId | None
) -> tuple[int, int, F64] | None:  # fmt: skip
    """How the base moved the child relative to what the agent measured: both times, and a tangent vector (6,)."""
    if child is None:
        return None
    T_m_k, T_m_n = sparse_map.pose(keyframe), sparse_map.pose(child)
    if T_m_k is None or T_m_n is None:
        return None
    table, row, child_row = sparse_map.keyframes, sparse_map.rows[keyframe], sparse_map.rows[child]
    if table.t_ns[child_row] <= table.t_ns[row]:
        return None
    change = se3.inverse(T_m_k) @ T_m_n @ se3.inverse(table.T_p_k[child_row])
    return int(table.t_ns[row]), int(table.t_ns[child_row]), se3.log(se3.orthonormalise(change))

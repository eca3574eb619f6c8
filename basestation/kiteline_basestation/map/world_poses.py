"""Poses of many keyframes at once: a pose graph moves all of a map within one step."""

import numpy as np

from kiteline_basestation.map.map_tables import KeyframeTable
from kiteline_core.arrays import F64, I32
from kiteline_core.geometry import se3, sim3

_FARTHEST_M = 1e7  # m along an axis: sums of a few such poses still have a code; only a faulty agent is farther


def is_near(T: F64) -> bool:
    """True if the translation of a pose (4,4) is within bounds, so that poses composed of it have a code."""
    return all(abs(x) <= _FARTHEST_M for x in T[:3, 3].tolist())  # NaN is not


def place_in_world(table: KeyframeTable, rows: I32, S_w_m: F64 | None, scale: float) -> None:
    """Set T_w_k and scale of keyframes of one submap from their T_m_k. S_w_m: (4,4) of the submap; None: identity."""
    T = table.T_m_k[rows]
    table.scale[rows] = scale
    T = T if S_w_m is None else S_w_m @ T
    if scale != 1.0:
        T[:, :3, :3] /= scale
    table.T_w_k[rows] = T


def in_submap(T_w_k: F64, S_w_m: F64 | None) -> F64:
    """T_m_k (n,4,4) of poses in w (n,4,4), in a submap that lies at S_w_m; None: identity."""
    if S_w_m is None:
        return T_w_k
    return np.array([se3.orthonormalise(T) for T in sim3.place(sim3.inverse(S_w_m), T_w_k)]).reshape(-1, 4, 4)

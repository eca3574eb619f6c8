"""What a proved overlap says of how two maps lie to each other in w, also after lengths in them have changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.loop_verification import LoopMatch
from kiteline_core.geometry import sim3
from kiteline_core.ids import KeyframeId

F64 = NDArray[np.float64]


def similarity(sparse_map: SparseMap, keyframe: KeyframeId) -> F64:
    """S_w_k (4,4): from lengths in units of its submap, before a keyframe, to w."""
    row = sparse_map.rows[keyframe]
    return sim3.of(float(sparse_map.keyframes.unit[row]), sparse_map.keyframes.T_w_k[row])


def motion_of(sparse_map: SparseMap, vote: LoopMatch) -> F64:
    """S_old_new (4,4): how the map of the new keyframe would have to move in w, to lie in that of the old."""
    S_old_new = sim3.of(vote.scale, vote.T_old_new)
    moved = similarity(sparse_map, vote.old) @ S_old_new @ sim3.inverse(similarity(sparse_map, vote.new))
    return sim3.normalise(moved)


def depth_of(sparse_map: SparseMap, vote: LoopMatch) -> float:
    """Median depth of the points that are one, in units of w."""
    return vote.depth_m * float(sparse_map.keyframes.unit[sparse_map.rows[vote.old]])


def edge_of(sparse_map: SparseMap, vote: LoopMatch) -> tuple[F64, float]:
    """The vote as an edge of the pose graph: T_old_new (4,4) in units of w, and how much longer the old one has, in w,
    what the new one has.
    """
    unit_old, unit_new = (float(sparse_map.keyframes.unit[sparse_map.rows[k]]) for k in (vote.old, vote.new))
    return sim3.stretched(vote.T_old_new, unit_old), vote.scale * unit_old / unit_new


def rescaled(vote: LoopMatch, factor: Mapping[KeyframeId, float]) -> LoopMatch:
    """A vote after lengths before its keyframes, in their submaps, have been multiplied by `factor`."""
    old, new = factor.get(vote.old, 1.0), factor.get(vote.new, 1.0)
    if old == 1.0 and new == 1.0:
        return vote
    T = sim3.stretched(vote.T_old_new, old)
    return replace(vote, T_old_new=T, scale=vote.scale * old / new, depth_m=vote.depth_m * old)

"""Verified matches of two keyframes, and the edges of the pose graph that they become."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.arrays import F64, I32, I64
from kiteline_core.geometry import sim3
from kiteline_core.ids import KeyframeId


@dataclass(frozen=True, slots=True, eq=False)
class LoopEdge:
    """A relative pose between two keyframes that show the same place.

    T_old_new: (4,4). inliers: landmarks that agree. depth_m: their median depth in the old keyframe. Lengths are in
    units of the old keyframe's submap. scale: how many of these one unit of the new keyframe's submap is.
    """

    new: KeyframeId
    old: KeyframeId
    T_old_new: F64
    inliers: int
    depth_m: float
    scale: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class LoopMatch(LoopEdge):
    """A geometrically verified match. new_landmarks, old_landmarks: (k,) ids of landmarks that are the same point."""

    new_landmarks: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    old_landmarks: I64 = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def edge(self) -> LoopEdge:
        """The match without its landmarks."""
        return LoopEdge(self.new, self.old, self.T_old_new, self.inliers, self.depth_m, self.scale)


Edge = TypeVar("Edge", bound=LoopEdge)


def similarity(sparse_map: SparseMap, keyframe: KeyframeId) -> F64:
    """S_w_k (4,4) of a keyframe, from the unit of its submap to the unit of w."""
    row = sparse_map.rows[keyframe]
    return sim3.of(float(sparse_map.keyframes.scale[row]), sparse_map.keyframes.T_w_k[row])


def correction_of(sparse_map: SparseMap, edge: LoopEdge) -> F64:
    """Similarity (4,4) in w that moves the new keyframe's map onto the old keyframe's map."""
    S_old_new = sim3.of(edge.scale, edge.T_old_new)
    moved = similarity(sparse_map, edge.old) @ S_old_new @ sim3.inverse(similarity(sparse_map, edge.new))
    return sim3.normalise(moved)


def depth_of(sparse_map: SparseMap, edge: LoopEdge) -> float:
    """Median depth of the matched landmarks in units of w."""
    return edge.depth_m * float(sparse_map.keyframes.scale[sparse_map.rows[edge.old]])


def graph_edge_of(sparse_map: SparseMap, edge: LoopEdge) -> tuple[F64, float]:
    """T_old_new (4,4) in units of w, and the scale of the old keyframe over that of the new one in w."""
    unit_old, unit_new = (float(sparse_map.keyframes.scale[sparse_map.rows[k]]) for k in (edge.old, edge.new))
    return sim3.with_scaled_translation(edge.T_old_new, unit_old), edge.scale * unit_old / unit_new


def rescaled(edge: Edge, factor: Mapping[KeyframeId, float]) -> Edge:
    """An edge after lengths near its keyframes, in units of their submaps, were multiplied by `factor`."""
    old, new = factor.get(edge.old, 1.0), factor.get(edge.new, 1.0)
    if old == 1.0 and new == 1.0:
        return edge
    T = sim3.with_scaled_translation(edge.T_old_new, old)
    return replace(edge, T_old_new=T, scale=edge.scale * old / new, depth_m=edge.depth_m * old)


def slot_pairs(sparse_map: SparseMap, first: I64, second: I64) -> tuple[I32, I32]:
    """Slots (n,) of pairs of landmark ids (m,) of which both landmarks are in the map."""
    a, b = sparse_map.find_landmarks(first), sparse_map.find_landmarks(second)
    known = (a >= 0) & (b >= 0)
    return a[known], b[known]

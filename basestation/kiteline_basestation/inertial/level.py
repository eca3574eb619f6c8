"""Roll and pitch of maps whose agents know gravity: loop closures keep them, merges have to agree with them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import sim3
from kiteline_core.ids import KeyframeId, SubmapId

_MOST_BENT = 0.5  # length of the mean of unit vectors: below it they have no common direction


@dataclass(frozen=True, slots=True)
class Level:
    """Gravity at keyframes of a map. rows: (p,) which of the given ones. up_w: (3,) against gravity in w, by them all.

    sigma: (p,) rad, of roll and pitch of each as it lies in w: what its agent knows gravity to, and by how much the map
    is bent against that.
    """

    rows: I64
    up_w: F64
    sigma: F64


def level_of(sparse_map: SparseMap, keyframes: Sequence[KeyframeId]) -> Level | None:
    """Gravity at the keyframes of one map, where their agents measured it; None if nowhere."""
    rows = np.array([i for i, k in enumerate(keyframes) if k in sparse_map.up], np.int64)
    if not len(rows):
        return None
    known = [sparse_map.up[keyframes[i]] for i in rows.tolist()]
    R = sparse_map.keyframes.T_w_k[[sparse_map.rows[keyframes[i]] for i in rows.tolist()], :3, :3]
    up, told = np.einsum("nij,nj->ni", R, np.array([u for u, _ in known])), np.array([s for _, s in known])
    mean = (up / (told * told)[:, None]).sum(axis=0) / np.sum(1.0 / (told * told))
    length = float(np.linalg.norm(mean))
    if length < _MOST_BENT:
        return None
    off = np.linalg.norm(np.cross(up, mean / length), axis=1)
    return Level(rows, mean / length, np.hypot(told, off))


def tilt_between(sparse_map: SparseMap, new: SubmapId, old: SubmapId, S_old_new: F64) -> tuple[float, float] | None:
    """Angle in rad between gravity of two submaps once S_old_new (4,4) has moved the new one in w, and its deviation.

    The deviation is that of the keyframe that knows gravity best, of each: the errors of one agent's are alike. None
    unless both are known.
    """
    levels = [level_of(sparse_map, _posed(sparse_map, submap)) for submap in (new, old)]
    if levels[0] is None or levels[1] is None:
        return None
    turned = sim3.rigid(S_old_new)[:3, :3] @ levels[0].up_w
    angle = np.arctan2(float(np.linalg.norm(np.cross(turned, levels[1].up_w))), float(turned @ levels[1].up_w))
    return float(angle), float(np.hypot(levels[0].sigma.min(), levels[1].sigma.min()))


def _posed(sparse_map: SparseMap, submap: SubmapId) -> list[KeyframeId]:
    return [k for k in sparse_map.submaps.get(submap, []) if sparse_map.pose(k) is not None]

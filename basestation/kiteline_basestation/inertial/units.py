"""The length in w of the unit in which a monocular agent measured its motion, along the keyframes of a map."""

from collections.abc import Sequence

import numpy as np

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.arrays import F64, I32
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId, submap_of_keyframe

_MIN_RUN = 5  # steps that tell a length
_MOST_GROWTH = 1.1  # by which lengths along a map differ from those of its unit


def units_of(sparse_map: SparseMap, rows: I32, run: int) -> F64:
    """Length (k,) in w of the agent's unit at keyframes in `rows` (k,), by age in each submap.

    One for a whole submap in metres: if it followed the map, nothing would hold lengths, and each bundle would stretch
    them a little. Once accelerations have corrected lengths, and hold them, the agent's steps from keyframe to keyframe
    tell it, the weighted median of `run` of them, by the lengths that they have in the map now. So do those of a submap
    in a unit of its own, which drifts.
    """
    table = sparse_map.keyframes
    number = {int(table.id[row]): i for i, row in enumerate(rows.tolist())}
    submaps = [submap_of_keyframe(KeyframeId(k)) for k in number]
    units = np.array([sparse_map.scale(s) for s in submaps])
    place = table.T_w_k[rows, :3, 3]
    for submap in dict.fromkeys(submaps):
        one, drifts = sparse_map.scale(submap), sparse_map.is_up_to_scale(submap)
        corrected = submap in sparse_map.scaled_submaps and sparse_map.has_metric_scale_by_imu(submap)
        if not (drifts or corrected):
            continue
        own = [k for k, s in enumerate(submaps) if s == submap]
        steps = [(k, p) for k in own if (p := number.get(int(table.parent[rows[k]]))) is not None]
        if len(steps) < _MIN_RUN:
            continue
        k, p = np.array(steps).T
        here = np.linalg.norm(place[k] - place[p], axis=1)
        told = np.linalg.norm(table.T_p_k[rows[k], :3, 3], axis=1)
        each = np.divide(here, told, out=np.full(len(k), one), where=told > 0.0)
        for i, keyframe in enumerate(k.tolist()):
            near = slice(max(i - run // 2, 0), i + run // 2 + 1)
            typical = _weighted_median(each[near], told[near])  # single steps may be torn
            units[keyframe] = typical if drifts else np.clip(typical, one / _MOST_GROWTH, one * _MOST_GROWTH)
    return units


def unit_in(sparse_map: SparseMap, keyframes: Sequence[KeyframeId], rows: I32, T_c_w: F64) -> float | None:
    """Length in w of the unit in which an agent told its steps to keyframes, if those in `rows` (k,) are at T_c_w
    (k,4,4): the weighted median of all steps between them. None without any.
    """
    table = sparse_map.keyframes
    number = {row: i for i, row in enumerate(rows.tolist())}
    told, here = list[float](), list[float]()
    for row in (row for k in keyframes if (row := sparse_map.rows[k]) in number):
        above, T_a_k = sparse_map.rows.get(KeyframeId(int(table.parent[row]))), table.T_p_k[row]
        while above is not None and above not in number:  # culled
            T_a_k = table.T_p_k[above] @ T_a_k
            above = sparse_map.rows.get(KeyframeId(int(table.parent[above])))
        if above is not None and T_a_k[:3, 3].any():
            told.append(float(np.linalg.norm(T_a_k[:3, 3])))
            here.append(float(np.linalg.norm((T_c_w[number[above]] @ se3.inverse(T_c_w[number[row]]))[:3, 3])))
    unit = _weighted_median(np.array(here) / np.array(told), np.array(told)) if told else 0.0
    return unit if unit > 0.0 else None


def _weighted_median(values: F64, weights: F64) -> float:
    """The value of (n,) below and above which there is half of the weight (n,)."""
    order = np.argsort(values, kind="stable")
    up_to = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(up_to, 0.5 * up_to[-1])), len(order) - 1)]])

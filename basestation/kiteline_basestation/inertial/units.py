"""The length in w of the unit in which a monocular agent measured its motion, along the keyframes of a map."""

from collections.abc import Sequence

import numpy as np

from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.arrays import F64, I32
from kiteline_core.ids import SEQUENCE_BITS, KeyframeId, SubmapId

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
    submaps = table.id[rows] >> SEQUENCE_BITS
    units = np.empty(len(rows))
    for submap in map(SubmapId, dict.fromkeys(submaps.tolist())):
        own, one = rows[submaps == submap], sparse_map.scale(submap)
        units[submaps == submap] = one
        drifts = sparse_map.is_up_to_scale(submap)
        corrected = submap in sparse_map.scaled_submaps and sparse_map.has_metric_scale_by_imu(submap)
        if not (drifts or corrected):
            continue
        k, told, here = _steps(sparse_map, own, rows, table.T_w_k[rows, :3, 3])
        if len(k) < _MIN_RUN:
            continue
        for i, keyframe in enumerate(k.tolist()):
            near = slice(max(i - run // 2, 0), i + run // 2 + 1)
            typical = _weighted_median(here[near] / told[near], told[near])  # single steps may be torn
            units[keyframe] = typical if drifts else np.clip(typical, one / _MOST_GROWTH, one * _MOST_GROWTH)
    return units


def unit_in(sparse_map: SparseMap, keyframes: Sequence[KeyframeId], rows: I32, place: F64) -> float | None:
    """Length in w of the unit in which an agent told its steps to keyframes, if those in `rows` (k,) are at place
    (k,3): the weighted median of all steps between them. None without any.
    """
    of = np.array([sparse_map.rows[k] for k in keyframes], np.int32)
    _, told, here = _steps(sparse_map, of[np.isin(of, rows)], rows, place)
    unit = _weighted_median(here / told, told) if len(told) else 0.0
    return unit if unit > 0.0 else None


def _steps(sparse_map: SparseMap, children: I32, rows: I32, place: F64) -> tuple[I32, F64, F64]:
    """An agent's steps to keyframes in rows `children` (n,) from their parents, if these are among `rows` (k,).

    Culled parents are skipped. place: (k,3) in w. Returns the index into `rows` of each step's end (m,), its length as
    told (m,) and in w (m,); steps without a length are left out.
    """
    table, number = sparse_map.keyframes, {row: i for i, row in enumerate(rows.tolist())}
    found, told, here = list[int](), list[float](), list[float]()
    for row in children.tolist():
        above, T_a_k = sparse_map.rows.get(KeyframeId(int(table.parent[row]))), table.T_p_k[row]
        while above is not None and above not in number and table.culled[above]:
            T_a_k = table.T_p_k[above] @ T_a_k
            above = sparse_map.rows.get(KeyframeId(int(table.parent[above])))
        if above in number and T_a_k[:3, 3].any():
            found.append(number[row])
            told.append(float(np.linalg.norm(T_a_k[:3, 3])))
            here.append(float(np.linalg.norm(place[number[row]] - place[number[above]])))
    return np.array(found, np.int32), np.array(told), np.array(here)


def _weighted_median(values: F64, weights: F64) -> float:
    """The value of (n,) below and above which there is half of the weight (n,)."""
    order = np.argsort(values, kind="stable")
    up_to = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(up_to, 0.5 * up_to[-1])), len(order) - 1)]])

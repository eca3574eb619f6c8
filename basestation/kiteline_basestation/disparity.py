"""How far an agent's disparities are off as a whole, from motion: its calibration is good to a tenth of a pixel or so.

Depths follow from motion up to one scale. A constant error of the disparity spoils that scale, and then near and far
points cannot both agree with what stereo measured: disparity = (1 + scale error) bf / z + offset, a straight line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import DisparityConfig
from kiteline_core.ids import SEQUENCE_BITS, AgentId, agent_of_submap
from kiteline_core.sparse_map import SparseMap

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Offset:
    """What remains of an agent's offset, and one deviation of it, both px. points: from how many."""

    value_px: float
    sigma_px: float
    points: int


def estimate(sparse_map: SparseMap, agent: AgentId, applied_px: float, config: DisparityConfig) -> Offset | None:
    """The offset that the present map still shows, one residual a point; None where points tell too little.

    applied_px: what is already taken off the agent's disparities.
    """
    table = sparse_map.keypoints
    points = sparse_map.roots()
    xyz, known = sparse_map.positions(points)
    points, xyz = points[known], xyz[known]
    starts, slots = sparse_map.observations(points)
    which = np.repeat(np.arange(len(points)), np.diff(starts))
    rows = table.row[slots]
    submap = sparse_map.keyframes.id[rows] >> SEQUENCE_BITS
    mine = np.isin(submap, [s for s in sparse_map.submaps if agent_of_submap(s) == agent])
    keep = mine & (table.inv_depth[slots] > 0)
    which, rows, slots = which[keep], rows[keep], slots[keep]
    T = sparse_map.keyframes.T_w_k[rows]
    depth = np.einsum("ni,ni->n", T[:, :3, 2], xyz[which] - T[:, :3, 3])
    bf = sparse_map.keyframes.camera[rows, 4]
    foreseen = bf / np.maximum(depth, 0.05)
    residual = bf * table.inv_depth[slots] - applied_px - foreseen
    seen = np.bincount(which, minlength=len(points))
    good = seen >= config.min_seen
    if int(np.count_nonzero(good)) < config.min_points:
        return None
    x = np.bincount(which, foreseen, len(points))[good] / seen[good]
    y = np.bincount(which, residual, len(points))[good] / seen[good]
    if float(np.percentile(x, 90)) < config.min_range * float(np.percentile(x, 10)):
        return None
    return _intercept(x, y)


def _intercept(x: F64, y: F64) -> Offset:
    """Straight line through points with outliers: Huber's weights, at 1.5 deviations by the median."""
    design = np.column_stack([np.ones_like(x), x])
    weight = np.ones_like(x)
    for _ in range(8):
        normal = design.T @ (weight[:, None] * design)
        line = np.linalg.solve(normal, design.T @ (weight * y))
        error = np.abs(y - design @ line)
        spread = 1.4826 * float(np.median(error)) + 1e-9
        weight = np.minimum(1.0, 1.5 * spread / np.maximum(error, 1e-12))
    deviation = spread * np.sqrt(float(np.linalg.inv(design.T @ design)[0, 0]))
    return Offset(float(line[0]), deviation, len(x))

"""What an agent's disparities are off by: its calibration is good to a tenth of a pixel or so.

Depths follow from motion up to a scale. An error of the disparities spoils that scale, and then near and far points,
points here and there in the image, cannot all agree with what stereo measured. So bundles of a whole map find the
error (`disparity_offset`) along with all else.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import DisparityConfig
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.geometry.disparity_offset import TERMS, none, terms
from kiteline_core.ids import BOOT_BITS, SEQUENCE_BITS, SUBMAP_BITS, AgentId
from kiteline_core.optimisation.bundle import Border, BundleProblem, BundleResult

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]


def at_keypoints(sparse_map: SparseMap, slots: I32) -> F64:
    """The terms (n,5) of an offset at keypoints."""
    camera = sparse_map.keyframes.camera[sparse_map.keypoints.row[slots]]
    return terms((sparse_map.keypoints.uv[slots] - camera[:, 2:4]) / np.maximum(camera[:, :2], 1e-9))


def offsets(sparse_map: SparseMap, slots: I32) -> F64:
    """What the disparities of keypoints (n,) are too large by in px, as far as that is known."""
    out = np.zeros(len(slots))
    agents = _agents(sparse_map, slots)
    for agent, offset in sparse_map.disparity_offset_px.items():
        own = agents == agent
        out[own] = at_keypoints(sparse_map, slots[own]) @ offset
    return out


def with_border(
    sparse_map: SparseMap, slots: I32, problem: BundleProblem, config: DisparityConfig
) -> tuple[BundleProblem, tuple[AgentId, ...]]:  # fmt: skip
    """A problem in which the offsets of all its agents' disparities are unknown too, and these agents, in order.

    slots: (m,) the problem's observations.
    """
    table = sparse_map.keypoints
    rows = table.row[slots]
    ranged = problem.measured[:, 2] >= 0
    of = _agents(sparse_map, slots)
    agents = tuple(AgentId(a) for a in np.unique(of[ranged]).tolist())
    if not agents:
        return problem, ()
    group = np.where(ranged, np.searchsorted(np.array(agents), of), -1).astype(np.int32)
    measured = problem.measured.copy()
    measured[ranged, 2] = (sparse_map.keyframes.camera[rows, 4] * table.inv_depth[slots])[ranged]
    focal = float(np.median(sparse_map.keyframes.camera[rows, 0]))
    sigma = np.array([config.prior_px, *[config.prior_rad * focal] * (TERMS - 1)])
    start = np.stack([sparse_map.disparity_offset_px.get(a, none()) for a in agents])
    border = Border(group, at_keypoints(sparse_map, slots), start, sigma / config.inflation)
    return replace(problem, measured=measured, border=border), agents


def forget(sparse_map: SparseMap, agents: tuple[AgentId, ...]) -> None:
    """Nothing is known to be off."""
    for agent in agents:
        if agent in sparse_map.disparity_offset_px:
            sparse_map.disparity_offset_px[agent] = none()


def stands_out(result: BundleResult, config: DisparityConfig) -> bool:
    """Whether what a bundle found is more than chance for one of the agents."""
    for g, offset in enumerate(result.offset):
        cov = config.inflation**2 * result.offset_cov[TERMS * g : TERMS * (g + 1), TERMS * g : TERMS * (g + 1)]
        if np.isfinite(cov).all() and float(offset @ np.linalg.solve(cov, offset)) > config.min_significance**2 * TERMS:
            return True
    return False


def take(
    sparse_map: SparseMap, agents: tuple[AgentId, ...], problem: BundleProblem, result: BundleResult,
    config: DisparityConfig,
) -> None:  # fmt: skip
    """Remember what a bundle found of its agents' disparities. Agents whose offset is known well are trusted more."""
    border = problem.border
    if border is None or not (np.isfinite(result.offset).all() and np.isfinite(result.offset_cov).all()):
        return
    for g, agent in enumerate(agents):
        sparse_map.disparity_offset_px[agent] = result.offset[g].copy()
        at = border.terms[border.group == g]
        cov = result.offset_cov[TERMS * g : TERMS * (g + 1), TERMS * g : TERMS * (g + 1)]
        sigma_px = config.inflation * float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", at, cov, at))))
        if sigma_px < config.calibrated_px:
            sparse_map.disparity_calibrated.add(agent)


def _agents(sparse_map: SparseMap, slots: I32) -> I64:
    ids = sparse_map.keyframes.id[sparse_map.keypoints.row[slots]]
    return np.asarray(ids >> (SEQUENCE_BITS + SUBMAP_BITS + BOOT_BITS))

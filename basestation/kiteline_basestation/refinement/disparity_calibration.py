"""Estimates each agent's disparity offset in full bundles: stereo calibrations are good to a tenth of a pixel or so.

Motion gives depths up to scale. With a disparity offset, stereo depths of near and far landmarks, and of different
parts of the image, cannot agree with them at one scale; so the offset (`disparity_offset`) is observable.
"""

from dataclasses import replace

import numpy as np

from kiteline_basestation.config import DisparityCalibrationConfig
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_core.arrays import F64, I32, I64
from kiteline_core.geometry.disparity_offset import GOOD_PX, TERMS, none, terms
from kiteline_core.ids import BOOT_BITS, SEQUENCE_BITS, SUBMAP_BITS, AgentId
from kiteline_core.optimisation.bundle import Border, BundleProblem, BundleResult

_PRIOR_RAD = 3e-4  # rad; of the right camera's rotation (times the focal length: px where x or y is 1)
_KNOWN_FROM = 2.0  # prior deviations, rms; from which the offset of earlier flights is that of a worn rig
_USUAL_ROWS_PX = 0.25  # px; by which rows are off in good calibrations: more, and the motion does not matter
_MIN_SIGNIFICANCE = 0.5  # standard deviations; from which an offset is accepted: by chance 1 in 20
_TAIL = 6.0  # standard deviations, inflated: beyond two of the prior's own it yields to the data
_DETERMINED = 0.7  # share of the prior's deviation; a term yields that data alone determine better
CALIBRATED_PX = 0.03  # px; standard deviation of the offset below which it counts as known
_WORN = 15.0  # factor on both deviations for a rig that has changed since its calibration: one or two pixels


def at_keypoints(sparse_map: SparseMap, slots: I32) -> F64:
    """Terms (n,5) of a disparity offset at keypoints (n,)."""
    camera = sparse_map.keyframes.camera[sparse_map.keypoints.row[slots]]
    return terms((sparse_map.keypoints.uv[slots] - camera[:, 2:4]) / np.maximum(camera[:, :2], 1e-9))


def offsets(sparse_map: SparseMap, slots: I32) -> F64:
    """Known excess of the disparities of keypoints (n,), px."""
    out = np.zeros(len(slots))
    agents = _agents(sparse_map, slots)
    for agent, offset in sparse_map.disparity_offset_px.items():
        own = agents == agent
        out[own] = at_keypoints(sparse_map, slots[own]) @ offset
    return out


def with_border(
    sparse_map: SparseMap, slots: I32, problem: BundleProblem, config: DisparityCalibrationConfig
) -> tuple[BundleProblem, tuple[AgentId, ...]]:  # fmt: skip
    """Add the disparity offsets of a problem's agents as unknowns. Returns it and these agents, in order.

    Without those who found a good calibration's themselves: pairs of frames tell it sooner and better than keyframes.
    slots: (m,) of the problem's observations.
    """
    table = sparse_map.keypoints
    rows = table.row[slots]
    of = _agents(sparse_map, slots)
    told = [a for a in sparse_map.disparity_offset_px if sparse_map.is_good_offset(a)]
    ranged = (problem.measured[:, 2] >= 0) & ~np.isin(of, told)
    agents = tuple(AgentId(a) for a in np.unique(of[ranged]).tolist())
    if not agents:
        return problem, ()
    group = np.where(ranged, np.searchsorted(np.array(agents), of), -1).astype(np.int32)
    measured = problem.measured.copy()
    measured[ranged, 2] = (sparse_map.keyframes.camera[rows, 4] * table.inv_depth[slots])[ranged]
    focal = float(np.median(sparse_map.keyframes.camera[rows, 0]))
    prior = _prior_px(focal)
    onboard = [sparse_map.onboard_sigma_px.get(a) for a in agents]
    tells = sideways_share(problem.T_c_m) >= config.min_sideways
    worn = prior * _WORN  # where forward motion told an agent no more than that its rig is worn
    sigma = np.stack([
        prior if s is None else worn if s > GOOD_PX and not tells else np.full(TERMS, s) for s in onboard
    ])  # fmt: skip
    start = np.stack([sparse_map.disparity_offset_px.get(a, none()) for a in agents])
    mean = np.stack([prior_mean(sparse_map, a) for a in agents])
    # What was found on board rests on this flight: data that contradict it are the fewer ones.
    believed = np.array([s is None and (tells or has_bent(sparse_map, a)) for a, s in zip(agents, onboard)])
    border = Border(
        group, at_keypoints(sparse_map, slots), start, sigma / config.inflation, _TAIL, _DETERMINED,
        _WORN, np.where(believed, config.inflation**2 * config.contradicts, np.inf), mean,
    )  # fmt: skip
    return replace(problem, measured=measured, border=border), agents


def prior_mean(sparse_map: SparseMap, agent: AgentId) -> F64:
    """Offset (5,) px about which an agent's is expected: that found on board, or of earlier flights if it is a worn
    rig's, else zero.

    An offset within what good calibrations have may be one that those flights hardly determined. Were the next ones
    held about it, and those after them about theirs, the prior would be no prior.
    """
    known, camera = sparse_map.known_offset_px.get(agent), sparse_map.cameras.get(agent)
    if known is None or camera is None:
        return none()
    return known if agent in sparse_map.onboard_sigma_px or _is_worn(known, camera.fx) else none()


def _is_worn(offset: F64, focal: float) -> bool:
    """True if an offset (5,) px is beyond those of good calibrations."""
    return float(np.sqrt(np.mean((offset / _prior_px(focal)) ** 2))) > _KNOWN_FROM


def _prior_px(focal: float) -> F64:
    """Standard deviations (5,) of a good calibration's offset."""
    return np.array([GOOD_PX, *[_PRIOR_RAD * focal] * (TERMS - 1)])


def has_bent(sparse_map: SparseMap, agent: AgentId) -> bool:
    """True if the rows of an agent's right image show that its mount has bent.

    What bends a mount turns the camera about all axes. Rows show two of the three turns directly: their offset in the
    middle and its growth along x. The third moves disparities.
    """
    rows = sparse_map.rows_px.get(agent)
    return rows is not None and float(np.sqrt(np.mean(np.square(rows[:2])))) > _USUAL_ROWS_PX


def sideways_share(T_c_m: F64) -> float:
    """Share of the squared motion between cameras (k,4,4) that is across the optical axis."""
    moved = np.einsum("kij,kj->ki", T_c_m[:-1, :3, :3], _centres(T_c_m[1:])) + T_c_m[:-1, :3, 3]
    squared = np.sum(np.square(moved), 0)
    return float(squared[:2].sum() / max(float(squared.sum()), 1e-12))


def _centres(T_c_m: F64) -> F64:
    """Positions (k,3) of cameras (k,4,4) in m."""
    return np.asarray(-np.einsum("kji,kj->ki", T_c_m[:, :3, :3], T_c_m[:, :3, 3]))


def reset_offsets(sparse_map: SparseMap, agents: tuple[AgentId, ...]) -> None:
    """Set the offsets of agents to what is expected without a bundle, where set before."""
    for agent in agents:
        if agent in sparse_map.disparity_offset_px:
            sparse_map.disparity_offset_px[agent] = prior_mean(sparse_map, agent)
            sparse_map.disparity_sigma_px.pop(agent, None)
            if agent in sparse_map.onboard_sigma_px:
                sparse_map.disparity_sigma_px[agent] = sparse_map.onboard_sigma_px[agent]


def is_significant(problem: BundleProblem, result: BundleResult, config: DisparityCalibrationConfig) -> bool:
    """True if the estimate for at least one agent differs significantly from what was known (Mahalanobis distance)."""
    known = None if problem.border is None else problem.border.mean
    for g, offset in enumerate(result.offset if known is None else result.offset - known):
        cov = config.inflation**2 * result.offset_cov[TERMS * g : TERMS * (g + 1), TERMS * g : TERMS * (g + 1)]
        if np.isfinite(cov).all() and float(offset @ np.linalg.solve(cov, offset)) > _MIN_SIGNIFICANCE**2 * TERMS:
            return True
    return False


def set_offsets(
    sparse_map: SparseMap, agents: tuple[AgentId, ...], problem: BundleProblem, result: BundleResult,
    config: DisparityCalibrationConfig,
) -> None:  # fmt: skip
    """Set the offsets of agents from a bundle; an accurate one makes the agent's disparities count more."""
    border = problem.border
    if border is None or not (np.isfinite(result.offset).all() and np.isfinite(result.offset_cov).all()):
        return
    for g, agent in enumerate(agents):
        if agent in sparse_map.onboard_sigma_px and (border.mean is None or not border.mean[g].any()):
            continue  # the bundle began before the agent told its own
        sparse_map.disparity_offset_px[agent] = result.offset[g].copy()
        at = border.terms[border.group == g]
        cov = result.offset_cov[TERMS * g : TERMS * (g + 1), TERMS * g : TERMS * (g + 1)]
        sigma_px = config.inflation * float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", at, cov, at))))
        if sigma_px < CALIBRATED_PX:
            sparse_map.disparity_calibrated.add(agent)
        sparse_map.disparity_sigma_px.pop(agent, None)
        if agent in sparse_map.onboard_sigma_px or _is_worn(result.offset[g], sparse_map.cameras[agent].fx):
            sparse_map.disparity_sigma_px[agent] = sigma_px


def _agents(sparse_map: SparseMap, slots: I32) -> I64:
    ids = sparse_map.keyframes.id[sparse_map.keypoints.row[slots]]
    return np.asarray(ids >> (SEQUENCE_BITS + SUBMAP_BITS + BOOT_BITS))

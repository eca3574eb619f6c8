"""Which of the matched landmarks are compatible with the state, and the update by them."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.ekf import covariance_kernels as kernels
from kiteline_agent.ekf.filter_state import FilterState
from kiteline_agent.ekf_config import EkfConfig
from kiteline_core.arrays import F64, I64, Bool

_FIRST_MATCHES = 6  # matches with which a compatible set is begun before the largest set is taken
_AGREE = 0.6  # share of the matches in a set at which no other set is tried


@dataclass(frozen=True, slots=True)
class Innovation:
    """Matched landmarks: slots (m,), residual (m,2) of x/z, y/z, and its Jacobian (m,2,3) by the landmark."""

    slots: I64
    residual: F64
    M: F64


def innovation(state: FilterState, slots: I64, xy: F64) -> tuple[Innovation, Bool]:
    """Residuals of observations (n,2) of landmarks (n,), and which of them lie before the camera (n,)."""
    R = state.T_o_c[:3, :3]
    local = (state.points[slots] - state.T_o_c[:3, 3]) @ R
    ahead = local[:, 2] > 1e-2
    local = local[ahead]
    predicted = local[:, :2] / local[:, 2:]
    M = np.empty((len(local), 2, 3))
    for r in range(2):
        M[:, r] = (R[:, r] - predicted[:, r : r + 1] * R[:, 2]) / local[:, 2:]
    return Innovation(slots[ahead], xy[ahead] - predicted, M), ahead


def divided(found: Innovation, factor: F64) -> Innovation:
    """The same observations in units (m,) of their own."""
    return Innovation(found.slots, found.residual / factor[:, None], found.M / factor[:, None, None])


def compatible(state: FilterState, found: Innovation, sigma: float, config: EkfConfig) -> Bool:
    """Mask (m,) of matches that are jointly compatible with the state.

    Each is taken if it fits given those taken before: a wrong one that the prior allows no longer fits then. As it may
    also be the first, several beginnings are tried, and the largest set is kept.
    Source: J. Neira, J. Tardos, "Data association in stochastic mapping using the joint compatibility test", 2001;
    J. Civera et al., "1-point RANSAC for EKF filtering", 2010.
    """
    m = len(found.slots)
    index = np.asarray(state.landmark_row(found.slots))
    S = np.empty((2 * m, 2 * m))
    kernels.innovation_covariance(state.P, index, found.M, sigma * sigma, S)
    residual = found.residual.ravel()
    pairs = S.reshape(m, 2, m, 2)[np.arange(m), :, np.arange(m), :]
    alone = np.einsum("mi,mi->m", found.residual, np.linalg.solve(pairs, found.residual[..., None])[..., 0])
    order = np.argsort(alone, kind="stable")
    order = order[alone[order] <= config.gate]
    L, white, taken = np.zeros((2 * m, 2 * m)), np.zeros(2 * m), np.zeros(m, np.int64)
    best: Bool = np.zeros(m, np.bool_)
    for seed in range(min(_FIRST_MATCHES, len(order))):
        begun = np.concatenate([order[seed : seed + 1], order[:seed], order[seed + 1 :]])
        count = kernels.compatible_set(S, residual, begun, config.gate, L, white, taken)
        if count > best.sum():
            best = np.zeros(m, np.bool_)
            best[taken[:count]] = True
        if count >= _AGREE * m:
            break
    return best


def update(state: FilterState, found: Innovation, sigma: float) -> None:
    """Update the state by observations."""
    m = len(found.slots)
    if m == 0:
        return
    index = np.asarray(state.landmark_row(found.slots))
    S = np.empty((2 * m, 2 * m))
    kernels.innovation_covariance(state.P, index, found.M, sigma * sigma, S)
    L, white, taken = np.zeros((2 * m, 2 * m)), np.zeros(2 * m), np.zeros(m, np.int64)
    kernels.compatible_set(S, found.residual.ravel(), np.arange(m), np.inf, L, white, taken)
    rows = np.empty((2 * m, state.size))
    kernels.innovation_rows(state.P, state.size, index, found.M, rows)
    state.update(rows, L, white)

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
    """Matched landmarks: slots (m,), residual (m,2) of x/z, y/z, its Jacobian (m,2,3) by the landmark, and its
    covariance S (2m,2m).
    """

    slots: I64
    residual: F64
    M: F64
    S: F64

    def part(self, chosen: I64) -> "Innovation":
        """Some of the matches (k,)."""
        pixels = (2 * chosen[:, None] + [0, 1]).ravel()
        return Innovation(self.slots[chosen], self.residual[chosen], self.M[chosen], self.S[np.ix_(pixels, pixels)])


def innovation(state: FilterState, slots: I64, xy: F64, coarse: F64, sigma: float) -> tuple[Innovation, Bool]:
    """Residuals of observations (n,2) of landmarks (n,), and which of them lie before the camera (n,).

    coarse: (n,) factors of the deviation sigma of an observation. Divided by them, all have the same.
    """
    R = state.T_o_c[:3, :3]
    local = (state.points[slots] - state.T_o_c[:3, 3]) @ R
    ahead = local[:, 2] > 1e-2
    local, slots, unit = local[ahead], slots[ahead], coarse[ahead, None]
    predicted = local[:, :2] / local[:, 2:]
    M = np.empty((len(local), 2, 3))
    for r in range(2):
        M[:, r] = (R[:, r] - predicted[:, r : r + 1] * R[:, 2]) / (local[:, 2:] * unit)
    S = np.empty((2 * len(local),) * 2)
    kernels.innovation_covariance(state.P, np.asarray(state.landmark_row(slots)), M, sigma * sigma, S)
    return Innovation(slots, (xy[ahead] - predicted) / unit, M, S), ahead


def compatible(found: Innovation, config: EkfConfig) -> Bool:
    """Mask (m,) of matches that are jointly compatible with the state.

    Each is taken if it fits given those taken before: a wrong one that the prior allows no longer fits then. As it may
    also be the first, several beginnings are tried, and the largest set is kept.
    Source: J. Neira, J. Tardos, "Data association in stochastic mapping using the joint compatibility test", 2001;
    J. Civera et al., "1-point RANSAC for EKF filtering", 2010.
    """
    m, S, residual = len(found.slots), found.S, found.residual.ravel()
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


def update(state: FilterState, found: Innovation) -> None:
    """Update the state by observations."""
    m = len(found.slots)
    if m == 0:
        return
    first = np.asarray(state.landmark_row(found.slots))
    points = state.rows((first[:, None] + np.arange(3)).ravel()).reshape(m, 3, -1)
    rows = found.M @ (points - state.rows(np.arange(3)))
    L = np.asarray(np.linalg.cholesky(found.S), np.float64)
    state.update(rows.reshape(2 * m, -1), L, np.asarray(np.linalg.solve(L, found.residual.ravel()), np.float64))

"""Correction of camera and past views by the rays of tracks, with the points where they intersect eliminated.

Source: A. Mourikis, S. Roumeliotis, "A multi-state constraint Kalman filter for vision-aided inertial navigation",
2007.
Where odometry is poor the views are off by a tenth of the way between them, and what a track tells is far from linear
in that: all tracks are linearised again at the corrected views (iterated Kalman filter).
"""

from collections.abc import Sequence

import numpy as np

from kiteline_agent.ekf.filter_state import FilterState
from kiteline_agent.ekf.ray_initialisation import Rays, RayTrack, linearised
from kiteline_core.arrays import F64, I64

_ITERATIONS = 3
_SETTLED = 0.1  # deviations of the state by which another iteration would have to change it
_MANY = 3.0  # deviations over degrees of freedom at which a track counts half: Cauchy's weights


def update_by_rays(state: FilterState, tracks: Sequence[RayTrack]) -> None:
    """Correct the state by tracks; those that contradict the others count less."""
    columns = state.view_columns(state.used_views)
    P = state.rows(columns)
    block = P[:, columns]
    deviation = np.sqrt(np.maximum(np.diagonal(block), 1e-24))
    change = np.zeros(len(columns))
    for _ in range(_ITERATIONS):
        T_o_c, view_T_o_c = state.corrected_views(columns, change)
        linear = [linearised(state, track, T_o_c, view_T_o_c) for track in tracks]
        every = [rays for rays in linear if rays is not None]
        if not every:
            return
        H, residual = _stacked(every, columns, change)
        L = np.asarray(np.linalg.cholesky(H @ block @ H.T + np.eye(len(H))), np.float64)
        white = np.asarray(np.linalg.solve(L, residual + H @ change), np.float64)
        last, change = change, block @ H.T @ np.linalg.solve(L.T, white)
        if (np.abs(change - last) < _SETTLED * deviation).all():
            break
    state.update(H @ P, L, white)


def _stacked(every: Sequence[Rays], columns: I64, change: F64) -> tuple[F64, F64]:
    """H (m,k) over the columns (k,) and the residual (m,), m <= k, each track by its weight."""
    H = np.zeros((sum(len(r.residual) for r in every), len(columns)))
    residual = np.zeros(len(H))
    at = 0
    for r in every:
        m = len(r.residual)
        weight = 1.0 / np.sqrt(1.0 + (r.residual @ r.residual) / (m * _MANY * _MANY)) if change.any() else 1.0
        H[at : at + m, np.searchsorted(columns, r.columns)] = weight * r.H
        residual[at : at + m] = weight * r.residual
        at += m
    if len(H) > len(columns):  # as many equations as unknowns tell the same
        q, H = np.linalg.qr(H)
        residual = q.T @ residual
    return np.asarray(H), residual

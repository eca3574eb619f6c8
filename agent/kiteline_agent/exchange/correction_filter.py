"""Weighs corrections of the live pose by the deviation of the base's scale and by that of what was reported before.

The scale of a monocular map is uncertain to a percent, and the base finds it anew with every bundle: each time the
vehicle moves in w by as much of its distance from the origin. A Kalman filter of the vehicle's place in w takes over of
each correction what it is worth beside those before.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import SmoothingConfig
from kiteline_core.geometry import se3

F64 = NDArray[np.float64]


class CorrectionFilter:
    """The pose of the odometry frame in w, by all corrections so far; later ones contain what earlier ones knew."""

    def __init__(self, config: SmoothingConfig) -> None:
        self._config = config
        self._told: F64 | None = None  # T_w_o as the base corrected it last
        self._kept = np.zeros(3)  # m in w: by how much of the corrections the vehicle was not moved
        self._variance = 0.0  # m^2, of the vehicle's place in w after the last correction
        self._place = np.zeros(3)  # of the vehicle in w then
        self._scale_sigma = config.scale_sigma  # relative deviation of what it has flown since

    def clear(self) -> None:
        """Take over the next correction as it is."""
        self._told = None

    def weigh(self, T_w_o: F64, here_o: F64, scale_sigma: float) -> F64:
        """The pose (4,4) of o to report if the base says T_w_o. here_o: (3,) m, vehicle in o.

        scale_sigma: relative deviation of lengths in w, 0 if they are certain or the base does not tell.
        """
        before, self._told = self._told, T_w_o
        if before is None or scale_sigma <= 0.0:
            self._take_over()
        elif not np.array_equal(before, T_w_o):
            self._fuse(before, T_w_o, here_o, scale_sigma)
        if not self._kept.any():
            return T_w_o
        out = T_w_o.copy()
        out[:3, 3] -= self._kept
        return out

    def _take_over(self) -> None:
        self._kept = np.zeros(3)
        self._variance, self._place = 0.0, np.zeros(3)
        self._scale_sigma = self._config.scale_sigma

    def _fuse(self, before: F64, T_w_o: F64, here_o: F64, scale_sigma: float) -> None:
        old, new = (se3.transform(T, here_o[None])[0] for T in (before, T_w_o))
        moved = new - old + self._kept  # from where it was reported
        if float(np.linalg.norm(moved)) > self._config.snap_m:
            self._take_over()
            return
        reported = self._variance + (self._scale_sigma * float(np.linalg.norm(new - self._place))) ** 2
        told = (scale_sigma * float(np.linalg.norm(new))) ** 2
        share = reported / max(reported + told, 1e-12)
        self._kept = (1.0 - share) * moved
        self._variance, self._place, self._scale_sigma = share * told, new, scale_sigma

"""Filters corrections of the live pose in a monocular map, whose scale is uncertain.

The base estimates the scale anew with every bundle, to about a percent. Each estimate moves the vehicle in w by that
share of its distance from the origin. A Kalman filter of the vehicle's position in w weighs each correction by the
deviation of the base's scale and that of the position reported so far.
"""

import numpy as np

from kiteline_agent.config import SmoothingConfig
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3


class CorrectionFilter:
    """The pose of the odometry frame in w, by all corrections so far. A later correction replaces the earlier ones."""

    def __init__(self, config: SmoothingConfig) -> None:
        self._config = config
        self._T_w_o: F64 | None = None  # as the base corrected it last
        self._withheld = np.zeros(3)  # m in w: part of the corrections that the filter does not apply
        self._variance = 0.0  # m^2, of the vehicle's position in w after the last correction
        self._position = np.zeros(3)  # m in w, of the vehicle at the last correction
        self._scale_sigma = config.scale_sigma  # relative deviation of lengths flown since the last correction

    def clear(self) -> None:
        """Take over the next correction as it is."""
        self._T_w_o = None

    def move_odometry(self, T_o_n: F64) -> None:
        """The odometry frame o lies at n (4,4) in the map, which no correction moved."""
        if self._T_w_o is not None:
            self._T_w_o = self._T_w_o @ T_o_n

    def weigh(self, T_w_o: F64, here_o: F64, scale_sigma: float) -> F64:
        """The pose (4,4) of o to report for the base's T_w_o. here_o: (3,) m, vehicle in o.

        scale_sigma: relative deviation of lengths in w, 0 if they are certain or it is unknown.
        """
        before, self._T_w_o = self._T_w_o, T_w_o
        if before is None or scale_sigma <= 0.0:
            self._take_over()
        elif not np.array_equal(before, T_w_o):
            self._fuse(before, T_w_o, here_o, scale_sigma)
        if not self._withheld.any():
            return T_w_o
        out = T_w_o.copy()
        out[:3, 3] -= self._withheld
        return out

    def _take_over(self) -> None:
        """Apply the whole correction."""
        self._withheld = np.zeros(3)
        self._variance, self._position = 0.0, np.zeros(3)
        self._scale_sigma = self._config.scale_sigma

    def _fuse(self, before: F64, T_w_o: F64, here_o: F64, scale_sigma: float) -> None:
        """Update the position by a correction, with the variances (m^2) of the reported and the corrected position."""
        old, new = (se3.transform(T, here_o[None])[0] for T in (before, T_w_o))
        moved = new - old + self._withheld  # from the reported position
        if float(np.linalg.norm(moved)) > self._config.snap_m:
            self._take_over()
            return
        reported = self._variance + (self._scale_sigma * float(np.linalg.norm(new - self._position))) ** 2
        corrected = (scale_sigma * float(np.linalg.norm(new))) ** 2
        gain = reported / max(reported + corrected, 1e-12)
        self._withheld = (1.0 - gain) * moved
        self._variance, self._position, self._scale_sigma = gain * corrected, new, scale_sigma

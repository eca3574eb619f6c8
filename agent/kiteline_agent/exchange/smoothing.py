"""Smooths corrections of the live pose: the odometry frame moves in the world at a limited speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import SmoothingConfig
from kiteline_core.geometry import se3, sim3

F64 = NDArray[np.float64]


class Smoothing:
    """The reported pose of the odometry frame in the world, which follows the corrected one."""

    def __init__(self, config: SmoothingConfig) -> None:
        self._config = config
        self._T_w_o: F64 | None = None
        self._t_ns = 0

    @property
    def on(self) -> bool:
        """True if corrections are smoothed."""
        return self._config.max_m_s > 0.0 or self._config.max_rad_s > 0.0

    def follow(self, T_w_o: F64, here_o: F64, t_ns: int) -> F64:
        """The pose (4,4) to report for the corrected T_w_o (4,4). here_o: (3,) m, vehicle in o.

        The frame rotates about the vehicle, and its speed is measured there. A scale, if w has another unit of length
        than o, is applied at once.
        """
        dt_s, self._t_ns = (t_ns - self._t_ns) * 1e-9, t_ns
        limits = self._config
        if self._T_w_o is None or not self.on or dt_s <= 0.0:
            self._T_w_o = T_w_o
            return T_w_o
        held = self._T_w_o
        moved = se3.transform(T_w_o, here_o[None])[0] - se3.transform(held, here_o[None])[0]
        rotation = se3.so3_log(sim3.rigid(T_w_o)[:3, :3] @ sim3.rigid(held)[:3, :3].T)
        distance, angle = float(np.linalg.norm(moved)), float(np.linalg.norm(rotation))
        if distance > limits.snap_m:
            self._T_w_o = T_w_o
            return T_w_o
        share = 1.0  # of the correction, applied in this time: translation and rotation end together
        if limits.max_m_s > 0.0 and distance > 0.0:
            share = min(share, limits.max_m_s * dt_s / distance)
        if limits.max_rad_s > 0.0 and angle > 0.0:
            share = min(share, limits.max_rad_s * dt_s / angle)
        if share >= 1.0:
            self._T_w_o = T_w_o
            return T_w_o
        R = se3.so3_exp(share * rotation) @ sim3.rigid(held)[:3, :3]
        at = se3.transform(held, here_o[None])[0] + share * moved
        scale = sim3.scale_of(T_w_o)
        self._T_w_o = sim3.normalise(sim3.of(scale, se3.from_rt(R, at - scale * R @ here_o)))
        return self._T_w_o

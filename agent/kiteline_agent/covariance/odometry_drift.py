"""Drift of the odometry frame since the flight began, as the map measures it."""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3


def covariance_by_map(cov_m: F64, T_o_m: F64, T_m_b: F64) -> F64:
    """Covariance (6,6) of T_o_b relative to the start of the flight, by the first submap, whose frame was o there.

    cov_m: of T_m_b (4,4). The map measures by how much o is off by now; that counts as a standard deviation.
    """
    turn = np.eye(6)
    turn[:3, :3] = T_o_m[:3, :3]
    off_m = (T_o_m @ T_m_b)[:3, 3] - T_m_b[:3, 3]
    off_rad = T_m_b[:3, :3].T @ se3.so3_log(T_o_m[:3, :3])
    cov = turn @ cov_m @ turn.T
    cov[:3, :3] += np.outer(off_m, off_m)
    cov[3:, 3:] += np.outer(off_rad, off_rad)
    return np.asarray(cov)

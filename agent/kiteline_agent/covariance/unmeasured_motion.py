"""Covariance of a motion that no sensor measures, from the accelerations that are likely."""

import numpy as np

from kiteline_agent.config import CovarianceConfig
from kiteline_core.arrays import F64

_LOST_VELOCITY_M_S = 0.03  # m/s: error of the velocity between two frames
_LOST_RATE_RAD_S = 0.02  # rad/s: the same for the rotation
_MOST_RAD2 = 10.0  # rad^2: no attitude is known less


def unmeasured_growth(config: CovarianceConfig, from_s: float, to_s: float, *, moves: bool) -> F64:
    """Covariance (6,6) that such motion adds between two times after images were lost.

    moves: the velocity was known when images were lost.
    """
    speed = (
        (_LOST_VELOCITY_M_S, _LOST_RATE_RAD_S) if moves else (config.unknown_velocity_m_s, config.unknown_rate_rad_s)
    )
    (m0, m1), (t0, t1) = (
        tuple(v * s + 0.5 * a * s * s for s in (from_s, to_s))
        for v, a in zip(speed, (config.unmeasured_accel_m_s2, config.unmeasured_turn_rad_s2), strict=True)
    )
    return np.diag(np.repeat([m1 * m1 - m0 * m0, min(t1 * t1 - t0 * t0, _MOST_RAD2)], 3))

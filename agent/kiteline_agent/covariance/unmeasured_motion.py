"""Covariance of a motion that no sensor measures, from the accelerations that are likely."""

import numpy as np

from kiteline_agent.config import CovarianceConfig
from kiteline_core.arrays import F64

_LOST_VELOCITY_M_S = 0.03  # m/s: error of the velocity between two frames
_LOST_RATE_RAD_S = 0.02  # rad/s: the same for the rotation
_MOST_RAD2 = 10.0  # rad^2: no attitude is known less


def unmeasured_growth(config: CovarianceConfig, from_s: float, to_s: float, over_s: float | None) -> F64:
    """Covariance (6,6) that such motion adds between two times after images were lost.

    over_s: s between the two poses that told the velocity, which is that of their middle; None: it was not known.
    """
    speed = (
        (_LOST_VELOCITY_M_S, _LOST_RATE_RAD_S)
        if over_s is not None
        else (config.unknown_velocity_m_s, config.unknown_rate_rad_s)
    )
    since_s = over_s or 0.0
    (m0, m1), (t0, t1) = (
        tuple(v * s + 0.5 * a * s * (s + since_s) for s in (from_s, to_s))
        for v, a in zip(speed, (config.unmeasured_accel_m_s2, config.unmeasured_turn_rad_s2), strict=True)
    )
    return np.diag(np.repeat([m1 * m1 - m0 * m0, min(t1 * t1 - t0 * t0, _MOST_RAD2)], 3))

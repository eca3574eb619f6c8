"""Velocity and angular rate at the end of a row of poses."""

from collections.abc import Sequence

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_QUADRATIC_S = 0.09  # s; over a shorter span noise outweighs what the acceleration explains


def end_rates(t_ns: Sequence[int], T_a_b: Sequence[F64], at_ns: int) -> tuple[F64, F64]:
    """Velocity (3,) m/s of b's origin in a, and angular rate (3,) rad/s in the axes of the last b, both at at_ns.

    t_ns, T_a_b: at least two poses (4,4) in order of time. A difference of two poses is the velocity of the instant
    half-way between them. Over a span that is long enough a parabola is fitted instead, and its slope at at_ns taken:
    it is not late under a constant acceleration, and with four poses or more no noisier than that difference.
    """
    last, R_b_a = T_a_b[-1], T_a_b[-1][:3, :3].T
    s = (np.array(t_ns, np.float64) - t_ns[-1]) * 1e-9
    y = np.array([np.concatenate([T[:3, 3] - last[:3, 3], se3.so3_log(R_b_a @ T[:3, :3])]) for T in T_a_b])
    if len(s) < 3 or -s[0] < _QUADRATIC_S:
        slope = (y[-1] - y[0]) / (s[-1] - s[0])
    else:
        span = -s[0]  # scales the columns alike
        fit = np.linalg.lstsq(np.vander(s / span, 3), y, rcond=None)[0]
        slope = fit[1] / span + 2.0 * fit[0] / span * ((at_ns - t_ns[-1]) * 1e-9 / span)
    return slope[:3], slope[3:]

"""Probability that a pose is as accurate as configured."""

import math

from kiteline_core.arrays import F64

# Quality, in percent, below which a pose is not to be relied on. Between 50 and this many are off by more than the
# limits; hardly a good one is there.
FLAGGED_BELOW = 75
LOST_BELOW = 50  # the same below which one by dead reckoning is none: it is as likely wrong as good


def probability_good(cov: F64, good_m: float, good_rad: float) -> float:
    """Probability that an error of covariance cov (6,6) is within both limits, taken as independent.

    The length of a Gaussian vector, by the cube root of its square (E. Wilson, M. Hilferty, 1931; for unequal axes
    D. Jensen, H. Solomon, 1972).
    """
    both = 1.0
    for block, limit in ((cov[:3, :3], good_m), (cov[3:, 3:], good_rad)):
        v = block.ravel().tolist()
        if (mean := sum(v[::4])) > 1e-18:  # the trace
            k = mean * mean / sum(x * x for x in v)
            z = ((limit * limit / mean) ** (1.0 / 3.0) - 1.0 + 2.0 / (9.0 * k)) / math.sqrt(2.0 / (9.0 * k))
            both *= 0.5 * math.erfc(-z / math.sqrt(2.0))
    return both

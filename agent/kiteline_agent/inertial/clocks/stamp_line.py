"""A robust line through stamps over the numbers of what was stamped."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.order_statistics import median

TAIL = 2.5  # deviations from which a stamp counts less
_FITS = 4  # each with the weights that the one before gave
_LEAST_S = 1e-9


@dataclass(frozen=True, slots=True)
class StampLine:
    """begin_s: at number 0. scatter_s: deviation of stamps about it, but for single late ones. off_s: (k,) of each."""

    begin_s: float
    period_s: float
    scatter_s: float
    off_s: F64


def stamp_line(n: F64, t_s: F64) -> StampLine:
    """The line through stamps t_s (k,) over numbers n (k,), of which two differ at least."""
    weight = np.ones(len(n))
    for _ in range(_FITS):
        share = weight / weight.sum()
        mean_n, mean_t = float(share @ n), float(share @ t_s)
        period_s = float(share @ ((n - mean_n) * (t_s - mean_t))) / float(share @ (n - mean_n) ** 2)
        begin_s = mean_t - period_s * mean_n
        off_s = t_s - begin_s - period_s * n
        scatter_s = 1.48 * median(np.abs(off_s))
        weight = 1.0 / np.maximum(1.0, np.abs(off_s) / max(TAIL * scatter_s, _LEAST_S)) ** 2
    return StampLine(begin_s, period_s, scatter_s, off_s)

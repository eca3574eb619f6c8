"""How likely measured disparities are under a hypothesis about their offset."""

import math

import numpy as np

from kiteline_core.arrays import F64


def probability(log_odds: float) -> float:
    """Of a hypothesis by its logarithmic odds."""
    return 1.0 / (1.0 + math.exp(-min(max(log_odds, -50.0), 50.0)))


class Prior:
    """A hypothesis about an offset (n,), normally distributed before the data.

    information: (n,n) before the data. side: (n,) of it, information @ mean; None: about zero.
    """

    def __init__(self, information: F64, side: F64 | None = None) -> None:
        self.information = information
        self._log_det = float(np.linalg.slogdet(information)[1])
        self._side = np.zeros(len(information)) if side is None else side
        self._fit = 0.0 if side is None else float(side @ np.linalg.solve(information, side))

    def log_evidence(self, h: F64, b: F64) -> float:
        """Logarithm, up to a constant of the data, of the likelihood of data with information h (n,n), side b (n,)."""
        after, side = h + self.information, b + self._side
        fit = float(side @ np.linalg.solve(after, side)) - self._fit
        return 0.5 * (fit + self._log_det - float(np.linalg.slogdet(after)[1]))

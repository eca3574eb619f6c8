"""How likely measured disparities are under a hypothesis about their offset."""

import math

import numpy as np

from kiteline_core.arrays import F64


def probability(log_odds: float) -> float:
    """Of a hypothesis by its logarithmic odds."""
    return 1.0 / (1.0 + math.exp(-min(max(log_odds, -50.0), 50.0)))


def log_evidence(h: F64, b: F64, prior: F64, side: F64 | None = None) -> float:
    """Logarithm, up to a constant of the data, of the likelihood of data with information h (5,5) and its side b (5,).

    prior: (5,5) information; side: (5,) of it, prior @ mean; None: about zero.
    """
    side = np.zeros(len(b)) if side is None else side
    fit = float((b + side) @ np.linalg.solve(h + prior, b + side) - side @ np.linalg.solve(prior, side))
    return 0.5 * (fit + float(np.linalg.slogdet(prior)[1]) - float(np.linalg.slogdet(h + prior)[1]))

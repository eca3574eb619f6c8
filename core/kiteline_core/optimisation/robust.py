"""Robust costs over squared, normalised residuals, and the chi-square bounds that tell an outlier."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

CHI2_2 = 5.991  # 95 % of a chi-square with 2 degrees of freedom: a pixel
CHI2_2_MEDIAN, CHI2_3_MEDIAN = 1.386, 2.366
CHI2_3 = 7.815  # 95 % with 3 degrees of freedom: a pixel and a disparity


def huber_cost(s: F64, bound: F64) -> F64:
    """Huber's cost of squared residual norms s (n,): s up to `bound`, then growing with sqrt(s) only.

    Source: P. Huber, "Robust estimation of a location parameter", 1964, written for squared norms.
    """
    outside = s > bound
    root = np.sqrt(np.where(outside, s, 1.0))
    return np.where(outside, 2.0 * np.sqrt(bound) * root - bound, s)


def huber_weight(s: F64, bound: F64) -> F64:
    """Derivative of `huber_cost` by s: the weight that a residual keeps in iterated least squares."""
    outside = s > bound
    return np.where(outside, np.sqrt(bound) / np.sqrt(np.where(outside, s, 1.0)), 1.0)

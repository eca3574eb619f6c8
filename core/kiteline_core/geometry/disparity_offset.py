"""Disparity offset over the image, from small errors of the right camera's rotation, focal length and centre.

The first terms of a homography, c0 + c1 x + c2 y + c3 x^2 + c4 x y in normalised image coordinates (R. Hartley, "Theory
and practice of projective rectification").
"""

import numpy as np

from kiteline_core.arrays import F64

TERMS = 5
GOOD_PX = 0.1  # px; standard deviation of an offset that a good calibration leaves


def terms(xy: F64) -> F64:
    """1, x, y, x^2, x y (n,5) of normalised image coordinates (n,2)."""
    x, y = xy[:, 0], xy[:, 1]
    out = np.empty((len(xy), TERMS))
    out[:, 0] = 1.0
    out[:, 1], out[:, 2] = x, y
    out[:, 3], out[:, 4] = x * x, x * y
    return out


def none() -> F64:
    """Zero offset (5,)."""
    return np.zeros(TERMS)

"""What the disparities of a pair are too large by, over the image.

What a right camera makes that is turned by a little, or of a little other focal length or centre, than its calibration
says: the first terms of a homography, c0 + c1 x + c2 y + c3 x^2 + c4 x y in normalised image coordinates (R. Hartley,
"Theory and practice of projective rectification").
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

TERMS = 5


def terms(xy: F64) -> F64:
    """1, x, y, x^2, x y (n,5) of normalised image coordinates (n,2)."""
    x, y = xy[:, 0], xy[:, 1]
    return np.stack([np.ones(len(xy)), x, y, x * x, x * y], 1)


def none() -> F64:
    """The offset (5,) of a pair that is as its calibration says."""
    return np.zeros(TERMS)

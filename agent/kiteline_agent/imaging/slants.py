"""The most probable slants of surfaces, from equations that were measured (`slant_kernels.measure_slants`)."""

import numpy as np

from kiteline_agent.imaging.alignment_kernels import PATCH_RADIUS
from kiteline_core.arrays import F64, U8

INFLATION = 4.0  # factor on variances: pixels of a patch share errors of the lens, of blur and of interpolation
LEAST_GREY = 2.0  # grey levels; deviation of a pixel: noise, and what interpolation costs
_MOST_CHANGE = 0.5  # of the inverse depth, from the middle of a patch to its edge: steeper surfaces are edges


def about_zero(equations: F64, slant: F64) -> F64:
    """Equations (n,5) of slants, from those of their errors, where slants (n,2) were assumed."""
    xx, xy, yy, bx, by = equations.T / INFLATION
    sx, sy = slant.T
    return np.column_stack([xx, xy, yy, bx + xx * sx + xy * sy, by + xy * sx + yy * sy])


def most_probable(equations: F64, sigma: float, octave: U8, focal_px: float) -> F64:
    """Slants (n,2) of equations (n,5), expected to be zero with a deviation sigma, of templates of octaves (n,)."""
    xx, xy, yy, bx, by = equations.T
    xx, yy = xx + sigma**-2, yy + sigma**-2
    found = np.column_stack([yy * bx - xy * by, xx * by - xy * bx]) / (xx * yy - xy**2)[:, None]
    most = _MOST_CHANGE * focal_px / (PATCH_RADIUS * (1 << octave))[:, None]
    return np.asarray(np.clip(found, -most, most), np.float64)

"""Quantisers of arrays. The codes are in SPEC.md, "Quantisers"; `quantise` passes the constants."""

import math

import numpy as np

from kiteline_core.arrays import F32, F64, I64
from kiteline_core.jit import njit

_LARGEST = 1e6  # 1/m: nearer than this takes the last code


@njit
def inverse_depth_codes(x: F64, scale: float, steps: int, n_codes: int, out: I64) -> None:
    """Codes (n,) of inverse depths (n,) in 1/m: a small float of x + scale; 0 where x <= 0 or not a number."""
    for i in range(x.size):
        if not x[i] > 0.0:
            out[i] = 0
            continue
        mantissa, exponent = math.frexp(min(x[i], _LARGEST) / scale + 1.0)  # mantissa in [0.5, 1)
        code = (exponent - 1) * steps + int(np.rint((2.0 * mantissa - 1.0) * steps))
        out[i] = min(max(code, 1), n_codes - 1)


@njit
def inverse_depths(codes: I64, scale: float, steps: int, out: F32) -> None:
    """Inverse depths (n,) in 1/m of codes (n,)."""
    for i in range(codes.size):
        mantissa = 1.0 + float(codes[i] % steps) / steps
        out[i] = (math.ldexp(mantissa, int(codes[i] // steps)) - 1.0) * scale

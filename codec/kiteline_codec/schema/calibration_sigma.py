"""What a stereo rig is off by on the wire: factors, and their standard deviation."""

import numpy as np

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.coding.quantise import CALIBRATION_SIGMA_CODES, CALIBRATION_STEPS
from kiteline_core.arrays import F64

_LIMIT = quantise.CALIBRATION_CODES // 2


def write_sigma(out: Writer, sigma_px: float | None) -> None:
    """Append a standard deviation in px, clipped; 0 for None."""
    code = 0 if sigma_px is None else min(max(round(sigma_px * CALIBRATION_STEPS), 1), CALIBRATION_SIGMA_CODES)
    out.varint(code)


def read_sigma(source: Reader) -> float | None:
    """The standard deviation in px. Raises WireError."""
    code = source.varint(CALIBRATION_SIGMA_CODES)
    return code / CALIBRATION_STEPS if code else None


def write_factors(out: Writer, px: F64) -> None:
    """Append factors in px, clipped."""
    for value in px.tolist():
        out.signed(min(max(round(value * CALIBRATION_STEPS), -_LIMIT), _LIMIT))


def read_factors(n: int, source: Reader) -> F64:
    """n factors in px. Raises WireError."""
    return np.array([source.signed(_LIMIT) for _ in range(n)], np.float64) / CALIBRATION_STEPS

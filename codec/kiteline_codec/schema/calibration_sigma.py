"""Standard deviation of a disparity offset on the wire."""

from __future__ import annotations

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.coding.quantise import CALIBRATION_SIGMA_CODES, CALIBRATION_STEPS


def write_sigma(out: Writer, sigma_px: float | None) -> None:
    """Append a standard deviation in px, clipped; 0 for None."""
    code = 0 if sigma_px is None else min(max(round(sigma_px * CALIBRATION_STEPS), 1), CALIBRATION_SIGMA_CODES)
    out.varint(code)


def read_sigma(source: Reader) -> float | None:
    """The standard deviation in px. Raises WireError."""
    code = source.varint(CALIBRATION_SIGMA_CODES)
    return code / CALIBRATION_STEPS if code else None

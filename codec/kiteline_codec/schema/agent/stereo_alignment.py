"""What an agent knows of its right camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.calibration_sigma import read_sigma, write_sigma
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.geometry import disparity_offset
from kiteline_core.ids import AgentId

_LIMIT = quantise.CALIBRATION_CODES // 2
_ROW_TERMS = 5


@register
@dataclass(frozen=True, slots=True)
class StereoAlignment(Record):
    """How the right camera lies, as the agent knows it. rows_px: (5,) factors of 1, x, y, x y, y^2 in normalised image
    coordinates by which the right image lies below its calibration, as measured. rows_read: whether it is read there,
    so that disparities are those of aligned rows. disparity_px: (5,) the error of
    disparities that the agent found, in this flight or an earlier one (`kiteline_core.geometry.disparity_offset`), zero
    if none is known. sigma_px: its standard deviation, rms over the image, if it was found in this flight; else None.
    """

    KIND = 9
    ID = IdOf.AGENT
    PRIORITY = Priority.CORRECTION

    agent: AgentId
    rows_px: NDArray[np.float64]
    rows_read: bool
    disparity_px: NDArray[np.float64]
    sigma_px: float | None = None

    def write(self, out: Writer) -> None:
        """Append whether rows are read, the factors, clipped, and the deviation."""
        out.u8(int(self.rows_read))
        for value in (*self.rows_px.tolist(), *self.disparity_px.tolist()):
            out.signed(min(max(round(value * quantise.CALIBRATION_STEPS), -_LIMIT), _LIMIT))
        write_sigma(out, self.sigma_px)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        read = source.u8()
        if read > 1:
            raise WireError(f"rows_read is {read}: expected 0 or 1")
        codes = [source.signed(_LIMIT) for _ in range(_ROW_TERMS + disparity_offset.TERMS)]
        px = np.array(codes, np.float64) / quantise.CALIBRATION_STEPS
        return cls(AgentId(key.id), px[:_ROW_TERMS], read == 1, px[_ROW_TERMS:], read_sigma(source))

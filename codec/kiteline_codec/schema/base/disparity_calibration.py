"""Calibration of an agent's stereo disparities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.batches import read_batch, write_batch
from kiteline_codec.schema.calibration_sigma import read_sigma, write_sigma
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.geometry import disparity_offset
from kiteline_core.ids import AgentId

_LIMIT = quantise.CALIBRATION_CODES // 2


@register
@dataclass(frozen=True, slots=True)
class DisparityCalibration(Record):
    """The error of an agent's disparities as the base estimated it. disparity_px: (5,) factors of 1, x, y, x^2, x y in
    normalised image coordinates (`kiteline_core.geometry.disparity_offset`), to be subtracted. sigma_px: its
    standard deviation, rms over the image; None while the rig passes for well calibrated. batch: see CorrectionBatch.
    """

    KIND = 25
    ID = IdOf.AGENT
    PRIORITY = Priority.CORRECTION

    agent: AgentId
    disparity_px: NDArray[np.float64]
    sigma_px: float | None = None
    batch: int = 0

    def write(self, out: Writer) -> None:
        """Append the factors, clipped, the deviation and the batch."""
        for value in self.disparity_px.tolist():
            out.signed(min(max(round(value * quantise.CALIBRATION_STEPS), -_LIMIT), _LIMIT))
        write_sigma(out, self.sigma_px)
        write_batch(out, self.batch)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        codes = [source.signed(_LIMIT) for _ in range(disparity_offset.TERMS)]
        px = np.array(codes, np.float64) / quantise.CALIBRATION_STEPS
        return cls(AgentId(key.id), px, read_sigma(source), read_batch(source))

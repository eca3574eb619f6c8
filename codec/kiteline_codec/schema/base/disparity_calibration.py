"""Calibration of an agent's stereo disparities."""

from dataclasses import dataclass
from functools import partial

from kiteline_codec.schema.batches import read_batch, write_batch
from kiteline_codec.schema.calibration_sigma import read_factors, read_sigma, write_factors, write_sigma
from kiteline_codec.schema.record import Field, IdOf, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.geometry import disparity_offset
from kiteline_core.ids import AgentId


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
    CODE = (
        Field("disparity_px", write_factors, partial(read_factors, disparity_offset.TERMS)),
        Field("sigma_px", write_sigma, read_sigma),
        Field("batch", write_batch, read_batch),
    )

    agent: AgentId
    disparity_px: F64
    sigma_px: float | None = None
    batch: int = 0

"""What an agent knows of its right camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema.calibration_sigma import read_factors, read_sigma, write_factors, write_sigma
from kiteline_codec.schema.record import Field, IdOf, Priority, Record, read_flag, register
from kiteline_core.geometry import disparity_offset
from kiteline_core.ids import AgentId

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
    CODE = (
        Field("rows_read", Writer.u8, lambda source: read_flag(source) == 1),
        Field("rows_px", write_factors, partial(read_factors, _ROW_TERMS)),
        Field("disparity_px", write_factors, partial(read_factors, disparity_offset.TERMS)),
        Field("sigma_px", write_sigma, read_sigma),
    )

    agent: AgentId
    rows_px: NDArray[np.float64]
    rows_read: bool
    disparity_px: NDArray[np.float64]
    sigma_px: float | None = None

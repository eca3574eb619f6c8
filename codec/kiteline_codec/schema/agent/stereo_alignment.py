"""What an agent knows of its right camera."""

from dataclasses import dataclass
from functools import partial
from typing import Any

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.calibration_sigma import read_factors, read_sigma, write_factors, write_sigma
from kiteline_codec.schema.record import Field, IdOf, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.geometry import disparity_offset
from kiteline_core.ids import AgentId

_ROW_TERMS = 5


class _Flags:
    """The code of the two flags."""

    def write(self, out: Writer, record: Any) -> None:
        """Append a byte: rows_read in bit 0, good_calibration in bit 1."""
        out.u8(int(record.rows_read) | int(record.good_calibration) << 1)

    def read(self, source: Reader, values: dict[str, Any]) -> dict[str, Any]:
        """The flags by name. Raises WireError."""
        flags = source.u8()
        if flags > 3:
            raise WireError(f"two flags are 0 to 3, found {flags}")
        return {"rows_read": bool(flags & 1), "good_calibration": bool(flags & 2)}


@register
@dataclass(frozen=True, slots=True)
class StereoAlignment(Record):
    """How the right camera lies, as the agent knows it. rows_px: (5,) factors of 1, x, y, x y, y^2 in normalised image
    coordinates by which the right image lies below its calibration, as measured. rows_read: whether it is read there,
    so that disparities are those of aligned rows. disparity_px: (5,) the error of disparities that the agent found, in
    this flight or an earlier one (`kiteline_core.geometry.disparity_offset`), zero if none is known. sigma_px: its
    standard deviation, rms over the image, if it is a worn rig's and was found in this flight; else None.
    good_calibration: it was found in this flight, but is no worn rig's: it is the most probable offset of a good
    calibration so far.
    """

    KIND = 9
    ID = IdOf.AGENT
    PRIORITY = Priority.CORRECTION
    CODE = (
        _Flags(),
        Field("rows_px", write_factors, partial(read_factors, _ROW_TERMS)),
        Field("disparity_px", write_factors, partial(read_factors, disparity_offset.TERMS)),
        Field("sigma_px", write_sigma, read_sigma),
    )

    agent: AgentId
    rows_px: F64
    rows_read: bool
    disparity_px: F64
    sigma_px: float | None = None
    good_calibration: bool = False

"""The unit of length of a monocular agent's submap."""

from dataclasses import dataclass

from kiteline_codec.schema.poses import read_scale, write_scale
from kiteline_codec.schema.record import Field, IdOf, Priority, Record, register
from kiteline_core.ids import SubmapId


@register
@dataclass(frozen=True, slots=True)
class SubmapScale(Record):
    """A monocular submap's unit of length. metres: in one unit; 1 for a submap that began in metres. A submap without
    this record has an unknown unit.
    """

    KIND = 7
    ID = IdOf.SUBMAP
    PRIORITY = Priority.POSE
    CODE = (Field("metres", write_scale, read_scale),)

    submap: SubmapId
    metres: float

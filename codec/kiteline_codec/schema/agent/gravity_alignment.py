"""The rotation that makes a submap's z axis point up."""

from dataclasses import dataclass

from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import Field, IdOf, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.ids import SubmapId


@register
@dataclass(frozen=True, slots=True)
class GravityAlignment(Record):
    """Aligns with gravity a submap that began while the vehicle moved.

    T_l_m: (4,4) submap to its gravity-aligned frame.
    """

    KIND = 6
    ID = IdOf.SUBMAP
    PRIORITY = Priority.POSE
    CODE = (Field("T_l_m", write_pose, read_pose),)

    submap: SubmapId
    T_l_m: F64

"""How a submap lies to the one before it: over a loss of images, or where a monocular map goes on in other metres."""

from dataclasses import dataclass

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema.poses import read_deviation, read_pose, write_deviation, write_pose
from kiteline_codec.schema.record import MAX_KEYFRAME_ID, Field, IdOf, Priority, Record, register
from kiteline_core.arrays import F64
from kiteline_core.ids import KeyframeId, SubmapId


@register
@dataclass(frozen=True, slots=True)
class SubmapTie(Record):
    """Motion of the camera while no image was tracked, by the IMU; or from a keyframe to a frame that was tracked.

    since: the last keyframe before, in whose submap's unit the motion is. T_k_f: (4,4) camera of the submap's first
    keyframe in it. sigma_m, sigma_rad: largest standard deviations of its position along any axis, and of its rotation
    about any; up to 0.47.
    """

    KIND = 10
    ID = IdOf.SUBMAP
    PRIORITY = Priority.POSE
    CODE = (
        Field("since", Writer.varint, lambda source: KeyframeId(source.varint(MAX_KEYFRAME_ID))),
        Field("T_k_f", write_pose, read_pose),
        Field("sigma_m", write_deviation, read_deviation),
        Field("sigma_rad", write_deviation, read_deviation),
    )

    submap: SubmapId
    since: KeyframeId
    T_k_f: F64
    sigma_m: float
    sigma_rad: float

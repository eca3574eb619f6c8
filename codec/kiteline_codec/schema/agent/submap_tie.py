"""How a submap lies to the one before it, over a loss of images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.poses import read_pose, write_pose
from kiteline_codec.schema.record import MAX_KEYFRAME_ID, IdOf, Key, Priority, Record, register
from kiteline_core.ids import KeyframeId, SubmapId


@register
@dataclass(frozen=True, slots=True)
class SubmapTie(Record):
    """Motion of the camera while no image was tracked, by the IMU.

    since: the last keyframe before. T_k_f: (4,4) camera of the submap's first keyframe in it. sigma_m, sigma_rad:
    largest standard deviations of its position along any axis, and of its rotation about any; up to 0.47.
    """

    KIND = 10
    ID = IdOf.SUBMAP
    PRIORITY = Priority.POSE

    submap: SubmapId
    since: KeyframeId
    T_k_f: NDArray[np.float64]
    sigma_m: float
    sigma_rad: float

    def write(self, out: Writer) -> None:
        """Append the keyframe, the motion and its deviations. Raises ValueError."""
        codes = quantise.deviation_code(self.sigma_m), quantise.deviation_code(self.sigma_rad)
        if 0 in codes:
            raise ValueError(f"found deviations of {self.sigma_m} m and {self.sigma_rad} rad, expected some above 0")
        out.varint(self.since)
        write_pose(out, self.T_k_f)
        for code in codes:
            out.u8(code)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        since = KeyframeId(source.varint(MAX_KEYFRAME_ID))
        T_k_f = read_pose(source)
        m, rad = source.u8(), source.u8()
        if not (0 < m < quantise.DEVIATION_CODES and 0 < rad < quantise.DEVIATION_CODES):
            raise WireError("a motion has two deviations above 0")
        return cls(SubmapId(key.id), since, T_k_f, quantise.deviation(m), quantise.deviation(rad))

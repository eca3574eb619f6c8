"""Poses and scales in codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, WireError, Writer


def write_pose(out: Writer, pose: NDArray[np.float64]) -> None:
    """Append a rigid motion (4,4). Raises ValueError."""
    for code in quantise.pose_codes(pose):
        out.signed(code)


def read_pose(source: Reader) -> NDArray[np.float64]:
    """A rigid motion (4,4). Raises WireError."""
    translation = [source.signed(quantise.TRANSLATION_CODES - 1) for _ in range(3)]
    rotation = [source.signed(quantise.ROTATION_STEPS) for _ in range(3)]
    try:
        return quantise.pose((*translation, *rotation))
    except ValueError as e:
        raise WireError(str(e)) from None


def write_scale(out: Writer, scale: float) -> None:
    """Append the ratio of two units of length. Raises ValueError."""
    if not quantise.MIN_SCALE <= scale <= quantise.MAX_SCALE:
        raise ValueError(f"found scale {scale}: expected a rigid motion, or a scale of 2^-20 to 2^20")
    out.f32(scale)


def read_scale(source: Reader) -> float:
    """The ratio of two units of length. Raises WireError."""
    scale = source.f32()
    if not quantise.MIN_SCALE <= scale <= quantise.MAX_SCALE:
        raise WireError(f"found scale {scale}: expected 2^-20 to 2^20")
    return scale


@dataclass(frozen=True, slots=True)
class Pose:
    """The code of a field that is a rigid motion (4,4)."""

    field: str

    def write(self, out: Writer, record: Any) -> None:
        """Append the pose. Raises ValueError."""
        write_pose(out, getattr(record, self.field))

    def read(self, source: Reader, values: dict[str, Any]) -> dict[str, Any]:
        """The pose by name. Raises WireError."""
        return {self.field: read_pose(source)}

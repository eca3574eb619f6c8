"""A map that was laid into another."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kiteline_core.ids import SubmapId

F64 = NDArray[np.float64]


@dataclass(slots=True)
class Merge:
    """A map that was laid into another. moved: its submaps and where they lay before, and how long (S_w_m)."""

    eldest: SubmapId
    into: SubmapId
    moved: dict[SubmapId, F64]
    fused: list[tuple[int, int]] = field(default_factory=list)  # slots of points that became one at the merge

"""Corrections of the base that wait until they matter: those of one keyframe at their newest value."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.schema import CulledLandmarks, RemovedObservations
from kiteline_core.ids import KeyframeId

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Removed = RemovedObservations | CulledLandmarks


@dataclass(slots=True)
class HeldCorrections:
    """Of keyframes of the local map: poses (4,4), refined landmarks (index, rho, bearing), landmarks to remove."""

    poses: dict[KeyframeId, F64] = field(default_factory=dict)
    landmarks: dict[KeyframeId, tuple[I64, F64, F64]] = field(default_factory=dict)
    removed: dict[tuple[KeyframeId, int], Removed] = field(default_factory=dict)  # by keyframe and kind of the record

    def forget(self, keyframe: KeyframeId) -> None:
        """Drop those of a keyframe that leaves the local map."""
        self.poses.pop(keyframe, None)
        self.landmarks.pop(keyframe, None)
        for kind in (RemovedObservations.KIND, CulledLandmarks.KIND):
            self.removed.pop((keyframe, kind), None)

    def clear(self) -> None:
        """Drop all: they were taken over."""
        self.poses.clear()
        self.landmarks.clear()
        self.removed.clear()

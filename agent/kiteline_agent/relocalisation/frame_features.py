"""Corners and descriptors of a whole frame, to match it with keyframes."""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.imaging import features
from kiteline_agent.imaging.features import DetectorConfig
from kiteline_agent.tracking.frame_images import FrameImages
from kiteline_core.arrays import F64, U8


@dataclass(frozen=True, slots=True)
class FrameFeatures:
    """Corners of a frame. uv: (n,2) px. octave, angle: (n,). descriptor: (n,32)."""

    uv: F64
    octave: U8
    angle: U8
    descriptor: U8


def frame_features(images: FrameImages, detector: DetectorConfig, min_corners: int) -> FrameFeatures | None:
    """Detect and describe corners; None if the image has too few."""
    corners = features.detect(
        images.left, np.zeros((0, 2)), replace(detector, first=max(detector.first, images.first))
    )  # fmt: skip
    if len(corners.uv) < min_corners:
        return None
    angle, descriptor = features.describe(images.left, corners.uv, corners.octave)
    return FrameFeatures(corners.uv, corners.octave, angle, descriptor)

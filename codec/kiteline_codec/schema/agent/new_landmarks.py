"""New landmarks of a keyframe."""

from dataclasses import dataclass

from kiteline_codec.schema.described_landmarks import DescribedLandmarks
from kiteline_codec.schema.record import IdOf, Priority, register


@register
@dataclass(frozen=True, slots=True)
class NewLandmarks(DescribedLandmarks):
    """Keypoints of a keyframe that became landmarks. inv_depth: as measured in the keyframe."""

    KIND = 4
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.LANDMARKS
    FIRST_PARTS = 4  # what makes a keyframe useful where a thin link has sections short
    PREDICTS = True

"""Landmarks that the base sends down into an agent's map cache."""

from dataclasses import dataclass

from kiteline_codec.schema.described_landmarks import DescribedLandmarks
from kiteline_codec.schema.record import IdOf, Priority, register


@register
@dataclass(frozen=True, slots=True)
class CachedLandmarks(DescribedLandmarks):
    """Landmarks of a cached keyframe at their refined positions. uv: px as the receiver's camera would see them."""

    KIND = 24
    ID = IdOf.CACHED_KEYFRAME
    PRIORITY = Priority.REST

"""New landmarks of a keyframe, as the local map stores them."""

from dataclasses import dataclass

from kiteline_core.arrays import F64, I64, U8


@dataclass(frozen=True, slots=True)
class KeyframeLandmarks:
    """Landmarks that a keyframe is the first to see.

    uv: (n,2) px. rho, sigma_rho: (n,) 1/m, inverse depth and its deviation; rho 0: without depth, a seed. octave: (n,).
    angle: (n,) in 1/256 turns. descriptor: (n,32). templates: (n,3,21,21) of the image's levels. order: (n,) in which
    landmarks are candidates, if nothing else decides; None for their own.
    """

    uv: F64
    rho: F64
    sigma_rho: F64
    octave: U8
    angle: U8
    descriptor: U8
    templates: U8
    order: I64 | None = None

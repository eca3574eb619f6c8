"""Matching of binary descriptors between two views: brute force, or guided by predicted pixels."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64, I32, U8, U64
from kiteline_core.imaging import matching_kernels as kernels

_CELL_PX = 32  # of the guided search; it changes its speed alone
_TURN_BINS = 16  # of the histogram of rotations between the two views; 22.5 degrees each
_TURN_BINS_KEPT = 3  # neighbours share a rotation between them
_MAX_HAMMING = 64  # bits of 256: unrelated descriptors differ in 128 +- 8, true matches in 20 to 60
_RATIO = 0.85  # of the best to the second-best distance: above it, the match is ambiguous


@dataclass(frozen=True, slots=True)
class Matches:
    """a, b: (n,) int32 indices of the pairs. distance: (n,) int32 bits."""

    a: I32
    b: I32
    distance: I32


def words(descriptors: U8) -> U64:
    """Descriptors (n,32) uint8 as (n,4) uint64 for the kernels."""
    return np.ascontiguousarray(descriptors).view(np.uint64).reshape(len(descriptors), 4)


def match(a: U8, angle_a: U8, b: U8, angle_b: U8) -> Matches:
    """Match descriptors (n,32) and (m,32) by brute force, one to one. Angles in 1/256 turns."""
    best, distance = np.empty(len(a), np.int32), np.empty(len(a), np.int32)
    kernels.match_all(words(a), words(b), _MAX_HAMMING, _RATIO, best, distance)
    kernels.keep_common_rotation(best, angle_a, angle_b, _TURN_BINS, _TURN_BINS_KEPT)
    return _pairs(best, distance)


def match_near(
    uv: F64, radius_px: F64, octave: F64, a: U8, uv2: F64, octave2: U8, b: U8, size: tuple[int, int],
    octave_gap: float,
) -> Matches:  # fmt: skip
    """Match each predicted pixel uv (n,2) with measured ones uv2 (m,2) within radius_px (n,).

    octave: (n,) predicted pyramid level; octave2: (m,) measured. size: width, height px of the image.
    """
    columns = -(-size[0] // _CELL_PX)
    rows = -(-size[1] // _CELL_PX)
    start, item = np.empty((rows, columns + 1), np.int32), np.empty(len(uv2), np.int32)
    kernels.fill_cells(uv2, float(_CELL_PX), start, item)
    best, distance = np.empty(len(a), np.int32), np.empty(len(a), np.int32)
    kernels.match_cells(
        uv, radius_px, octave, words(a), uv2, octave2, words(b), float(_CELL_PX), start, item,
        octave_gap, _MAX_HAMMING, _RATIO, best, distance,
    )  # fmt: skip
    return _pairs(best, distance)


def _pairs(best: I32, distance: I32) -> Matches:
    kept = np.flatnonzero(best >= 0).astype(np.int32)
    return Matches(kept, best[kept], distance[kept])

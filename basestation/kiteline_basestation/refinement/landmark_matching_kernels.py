"""Kernels that match descriptors: of projected landmarks in a circle, of keypoints along epipolar lines."""

import numpy as np

from kiteline_core.arrays import F64, I32, U8, U64
from kiteline_core.imaging.matching_kernels import hamming, take
from kiteline_core.jit import njit


@njit
def match_projected(
    uv: F64, octave: F64, angle: U8, disparity: F64, descriptor: U64,
    uv2: F64, octave2: U8, angle2: U8, disparity2: F64, descriptor2: U64,
    radius_px: float, octave_gap: float, angle_gap: int, disparity_px: float, max_hamming: int, ratio: float,
    best: I32, distance: I32,
) -> None:  # fmt: skip
    """Match projected landmarks one to one with keypoints.

    Landmarks: predicted uv (n,2) px, octave (n,) float, angle (n,) 1/256 turns, disparity (n,) px, descriptor (n,4)
    uint64.
    Keypoints: the same, measured; disparity2 (m,) negative where unknown. Writes best (n,), -1 none, and distance.
    """
    n, m = uv.shape[0], uv2.shape[0]
    owner = np.full(m, -1, np.int32)
    owner_distance = np.full(m, 1 << 20, np.int32)
    for i in range(n):
        best[i] = -1
        first, second, chosen = 1 << 20, 1 << 20, -1
        for j in range(m):
            scale = 2.0 ** octave2[j]
            r = radius_px * scale
            du, dv = uv2[j, 0] - uv[i, 0], uv2[j, 1] - uv[i, 1]
            if abs(dv) > r or abs(du) > r or du * du + dv * dv > r * r:
                continue
            if abs(octave2[j] - octave[i]) > octave_gap:
                continue
            turn = (int(angle2[j]) - int(angle[i])) & 255
            if min(turn, 256 - turn) > angle_gap:
                continue
            if disparity2[j] >= 0.0 and abs(disparity2[j] - disparity[i]) > disparity_px * scale:
                continue
            d = hamming(descriptor, i, descriptor2, j)
            if d < first:
                first, second, chosen = d, first, j
            elif d < second:
                second = d
        if chosen >= 0 and first <= max_hamming and first <= ratio * second:
            distance[i] = first
            take(i, chosen, first, owner, owner_distance, best)


@njit
def match_epipolar(
    uv: F64, octave: U8, descriptor: U64, uv2: F64, octave2: U8, descriptor2: U64, fundamental: F64,
    epipolar_px: float, max_hamming: int, ratio: float, best: I32, distance: I32,
) -> None:  # fmt: skip
    """Match keypoints one to one with keypoints of a second view along epipolar lines.

    fundamental (3,3): line2 = fundamental @ (u, v, 1). Writes best (n,) int32, -1 none, and distance (n,) in bits.
    """
    n, m = uv.shape[0], uv2.shape[0]
    owner = np.full(m, -1, np.int32)
    owner_distance = np.full(m, 1 << 20, np.int32)
    for i in range(n):
        best[i] = -1
        a = fundamental[0, 0] * uv[i, 0] + fundamental[0, 1] * uv[i, 1] + fundamental[0, 2]
        b = fundamental[1, 0] * uv[i, 0] + fundamental[1, 1] * uv[i, 1] + fundamental[1, 2]
        c = fundamental[2, 0] * uv[i, 0] + fundamental[2, 1] * uv[i, 1] + fundamental[2, 2]
        norm = np.sqrt(a * a + b * b)
        if norm < 1e-12:
            continue
        first, second, chosen = 1 << 20, 1 << 20, -1
        for j in range(m):
            gap = abs(a * uv2[j, 0] + b * uv2[j, 1] + c) / norm
            if gap > epipolar_px * 2.0 ** octave2[j] or abs(int(octave2[j]) - int(octave[i])) > 1:
                continue
            d = hamming(descriptor, i, descriptor2, j)
            if d < first:
                first, second, chosen = d, first, j
            elif d < second:
                second = d
        if chosen >= 0 and first <= max_hamming and first <= ratio * second:
            distance[i] = first
            take(i, chosen, first, owner, owner_distance, best)

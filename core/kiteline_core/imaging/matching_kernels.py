"""Kernels that match 256-bit descriptors by their Hamming distance."""

import numpy as np

from kiteline_core.arrays import F64, I32, U8, U64
from kiteline_core.jit import helper, njit

_M1 = np.uint64(0x5555555555555555)
_M2 = np.uint64(0x3333333333333333)
_M4 = np.uint64(0x0F0F0F0F0F0F0F0F)
_H = np.uint64(0x0101010101010101)
_S1, _S2, _S4, _S56 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)
_FAR = 1 << 20  # more bits than any two descriptors differ in


@helper
def count_bits(x: np.uint64) -> int:
    """Number of bits that are set."""
    x = x - ((x >> _S1) & _M1)
    x = (x & _M2) + ((x >> _S2) & _M2)
    x = (x + (x >> _S4)) & _M4
    return int((x * _H) >> _S56)


@helper
def hamming(a: U64, i: int, b: U64, j: int) -> int:
    """Number of bits that differ between a[i] and b[j]; descriptors are (n,4) uint64."""
    total = 0
    for k in range(4):
        total += count_bits(a[i, k] ^ b[j, k])
    return total


@helper
def take(i: int, j: int, distance: int, owner: I32, owner_distance: I32, best: I32) -> bool:
    """Assign j to i if i is nearer than j's current match, which is then undone. Returns whether i got j."""
    if distance >= owner_distance[j]:
        return False
    if owner[j] >= 0:
        best[owner[j]] = -1
    owner[j], owner_distance[j], best[i] = i, distance, j
    return True


@njit
def match_all(a: U64, b: U64, max_hamming: int, ratio: float, best: I32, distance: I32) -> int:
    """Match each of a (n,4) with the nearest of b (m,4), if near, distinctive and one to one.

    best: (n,) index in b or -1, out. distance: (n,) bits, out. Returns the number of matches.
    """
    n, m = a.shape[0], b.shape[0]
    owner = np.full(m, -1, np.int32)
    owner_distance = np.full(m, _FAR, np.int32)
    for i in range(n):
        best[i] = -1
        distance[i] = _FAR
        first, second, chosen = _FAR, _FAR, -1
        for j in range(m):
            d = hamming(a, i, b, j)
            if d < first:
                first, second, chosen = d, first, j
            elif d < second:
                second = d
        if chosen < 0 or first > max_hamming or first > ratio * second:
            continue
        if take(i, chosen, first, owner, owner_distance, best):
            distance[i] = first
    return _count(best)


@njit
def fill_cells(uv: F64, cell_px: float, start: I32, item: I32) -> None:
    """Sort pixels (m,2) into square cells. start: (rows, columns + 1) out; item: (m,) indices in order of cell, out.

    Cell (r, c) holds item[start[r, c]:start[r, c + 1]]. Pixels outside belong to the nearest cell.
    """
    rows, columns = start.shape[0], start.shape[1] - 1
    m = uv.shape[0]
    cell = np.empty(m, np.int64)
    count = np.zeros(rows * columns + 1, np.int64)
    for j in range(m):
        r = min(max(int(uv[j, 1] / cell_px), 0), rows - 1)
        c = min(max(int(uv[j, 0] / cell_px), 0), columns - 1)
        cell[j] = r * columns + c
        count[cell[j] + 1] += 1
    for k in range(rows * columns):
        count[k + 1] += count[k]
    for r in range(rows):
        for c in range(columns + 1):
            start[r, c] = count[r * columns + c]
    for j in range(m):
        item[count[cell[j]]] = j
        count[cell[j]] += 1


@njit
def match_cells(
    uv: F64, radius_px: F64, octave: F64, a: U64,
    uv2: F64, octave2: U8, b: U64, cell_px: float, start: I32, item: I32,
    octave_gap: float, max_hamming: int, ratio: float, best: I32, distance: I32,
) -> int:  # fmt: skip
    """Like match_all, but only within radius_px (n,) of the predicted pixel uv (n,2), by cells.

    octave: (n,) predicted pyramid level, octave2: (m,) measured. start, item: of uv2 (m,2) by fill_cells.
    """
    n, m = uv.shape[0], uv2.shape[0]
    rows, columns = start.shape[0], start.shape[1] - 1
    owner = np.full(m, -1, np.int32)
    owner_distance = np.full(m, _FAR, np.int32)
    for i in range(n):
        best[i] = -1
        distance[i] = _FAR
        first, second, chosen = _FAR, _FAR, -1
        reach = radius_px[i]
        top = min(max(int(np.floor((uv[i, 1] - reach) / cell_px)), 0), rows - 1)
        bottom = min(max(int(np.floor((uv[i, 1] + reach) / cell_px)), 0), rows - 1)
        left = min(max(int(np.floor((uv[i, 0] - reach) / cell_px)), 0), columns - 1)
        right = min(max(int(np.floor((uv[i, 0] + reach) / cell_px)), 0), columns - 1)
        for r in range(top, bottom + 1):
            for s in range(start[r, left], start[r, right + 1]):
                j = int(item[s])
                du, dv = uv2[j, 0] - uv[i, 0], uv2[j, 1] - uv[i, 1]
                if du * du + dv * dv > reach * reach or abs(octave2[j] - octave[i]) > octave_gap:
                    continue
                d = hamming(a, i, b, j)
                if d < first:
                    first, second, chosen = d, first, j
                elif d < second:
                    second = d
        if chosen < 0 or first > max_hamming or first > ratio * second:
            continue
        if take(i, chosen, first, owner, owner_distance, best):
            distance[i] = first
    return _count(best)


@njit
def keep_common_rotation(best: I32, angle: U8, angle2: U8, bins: int, kept: int) -> int:
    """Remove matches whose image rotation is not among the most frequent (ORB-SLAM's orientation histogram).

    best: (n,) in and out. angle (n,), angle2 (m,): 1/256 turns. kept: number of `bins` bins that are kept, ranked with
    their two neighbours counted in. Returns the number of matches left.
    """
    count = np.zeros(bins, np.int64)
    for i in range(best.shape[0]):
        if best[i] >= 0:
            rotation = (int(angle2[best[i]]) - int(angle[i])) & 255
            count[rotation * bins >> 8] += 1
    is_kept = np.zeros(bins, np.bool_)
    for _ in range(kept):
        top, most = -1, 0
        for k in range(bins):
            if is_kept[k]:
                continue
            around = count[k] * 2 + count[(k + 1) % bins] + count[(k + bins - 1) % bins]
            if around > most:
                top, most = k, around
        if top >= 0:
            is_kept[top] = True
    for i in range(best.shape[0]):
        if best[i] >= 0:
            rotation = (int(angle2[best[i]]) - int(angle[i])) & 255
            if not is_kept[rotation * bins >> 8]:
                best[i] = -1
    return _count(best)


@njit
def _count(best: I32) -> int:
    n = 0
    for i in range(best.shape[0]):
        if best[i] >= 0:
            n += 1
    return n

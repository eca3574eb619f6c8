"""Kernels of k-majority clustering of binary descriptors."""

import numpy as np

from kiteline_core.arrays import I32, I64, U64
from kiteline_core.imaging.matching_kernels import hamming
from kiteline_core.jit import njit


@njit
def spread_centres(descriptor: U64, member: I64, start: int, centre: U64) -> int:
    """Choose initial centres: member `start`, then always the member farthest from those chosen.

    descriptor: (n,4). member: (m,) rows of the cluster. centre: (k,4) out. Returns the number of distinct centres.
    """
    m, k = member.shape[0], centre.shape[0]
    nearest = np.full(m, 1 << 20, np.int64)
    chosen = start
    for c in range(k):
        centre[c] = descriptor[member[chosen]]
        far, chosen = -1, 0
        for i in range(m):
            d = hamming(descriptor, member[i], centre, c)
            nearest[i] = min(nearest[i], d)
            if nearest[i] > far:
                far, chosen = nearest[i], i
        if far == 0:
            for rest in range(c + 1, k):
                centre[rest] = centre[c]
            return c + 1
    return int(k)


@njit
def assign_to_nearest(descriptor: U64, member: I64, centre: U64, label: I32) -> int:
    """Label each member with its nearest centre (the first of equals). label: (m,) in, out. Returns the changes."""
    changed = 0
    for i in range(member.shape[0]):
        first, chosen = 1 << 20, 0
        for c in range(centre.shape[0]):
            d = hamming(descriptor, member[i], centre, c)
            if d < first:
                first, chosen = d, c
        if label[i] != chosen:
            label[i] = chosen
            changed += 1
    return changed


@njit
def update_centres(descriptor: U64, member: I64, label: I32, centre: U64) -> None:
    """Set each bit of a centre to the majority of its members; a centre without members stays."""
    k = centre.shape[0]
    ones = np.zeros((k, 256), np.int64)
    size = np.zeros(k, np.int64)
    for i in range(member.shape[0]):
        c = label[i]
        size[c] += 1
        for w in range(4):
            bits = descriptor[member[i], w]
            for b in range(64):
                ones[c, w * 64 + b] += int((bits >> np.uint64(b)) & np.uint64(1))
    for c in range(k):
        if size[c] == 0:
            continue
        for w in range(4):
            bits = np.uint64(0)
            for b in range(64):
                if 2 * ones[c, w * 64 + b] > size[c]:
                    bits |= np.uint64(1) << np.uint64(b)
            centre[c, w] = bits

"""Kernels of the place index: visual words of descriptors, postings, and similarity scores."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core.imaging.matching_kernels import hamming
from kiteline_core.jit import njit

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U64 = NDArray[np.uint64]


@njit
def find_words(descriptor: U64, centres: U64, branching: int, levels: int, word: I32) -> None:
    """The leaf of each descriptor (n,4), descending to the nearest child at every level.

    centres: (branching + branching^2 + ..., 4) level by level; the children of node i of a level are nodes
    i * branching ... of the next. word: (n,) leaf number, out. Ties go to the first child.
    """
    for i in range(descriptor.shape[0]):
        node, base, width = 0, 0, branching
        for _ in range(levels):
            first, chosen = 1 << 20, 0
            for c in range(node * branching, node * branching + branching):
                d = hamming(descriptor, i, centres, base + c)
                if d < first:
                    first, chosen = d, c
            node = chosen
            base += width
            width *= branching
        word[i] = node


@njit
def histogram(word: I32, weight: F32, scratch: F64, out_word: I32, out_value: F64) -> int:
    """Vector of unit L1 norm of words (n,): each word once, with its count times its weight (tf-idf).

    weight: (words,) idf. scratch: (words,) zeros in and out. out_word, out_value: (n,) out. Returns their number.
    """
    n, total = 0, 0.0
    for i in range(word.shape[0]):
        w = word[i]
        if weight[w] <= 0.0:
            continue
        if scratch[w] == 0.0:
            out_word[n] = w
            n += 1
        scratch[w] += weight[w]
        total += weight[w]
    for i in range(n):
        out_value[i] = scratch[out_word[i]] / total
        scratch[out_word[i]] = 0.0
    return n


@njit
def insert(
    word: I32, value: F64, done: int, place: int, top: I32, start: I32, size: I32, room: I32, owner: I32, value_of: F32
) -> int:  # fmt: skip
    """Append the entries of a place, from number `done` on, to the runs of their words.

    start, size, room: (words,) of each run. owner, value_of: (capacity,) of each posting. top: (1,) first unused
    posting, in and out. A full run moves to the top with half as much capacity again. Returns the number of the entry
    at which it ended: less than all if there is no space at the top.
    """
    for i in range(done, word.shape[0]):
        w = word[i]
        if size[w] == room[w]:
            more = max(4, room[w] + room[w] // 2)
            if top[0] + more > owner.shape[0]:
                return i
            for k in range(size[w]):
                owner[top[0] + k] = owner[start[w] + k]
                value_of[top[0] + k] = value_of[start[w] + k]
            start[w], room[w] = top[0], more
            top[0] += more
        owner[start[w] + size[w]] = place
        value_of[start[w] + size[w]] = value[i]
        size[w] += 1
    return len(word)


@njit
def move_runs(
    top: I32, start: I32, size: I32, room: I32, owner: I32, value_of: F32, owner2: I32, value_of2: F32
) -> None:
    """Copy all runs to larger arrays, without gaps. room: (words,) new capacity of each run."""
    top[0] = 0
    for w in range(start.shape[0]):
        for k in range(size[w]):
            owner2[top[0] + k] = owner[start[w] + k]
            value_of2[top[0] + k] = value_of[start[w] + k]
        start[w] = top[0]
        top[0] += room[w]


@njit
def remove(word: I32, place: int, start: I32, size: I32, owner: I32, value_of: F32) -> None:
    """Remove the postings of a place; the last posting of a run fills the gap."""
    for i in range(word.shape[0]):
        w = word[i]
        for k in range(start[w], start[w] + size[w]):
            if owner[k] == place:
                size[w] -= 1
                owner[k], value_of[k] = owner[start[w] + size[w]], value_of[start[w] + size[w]]
                break


@njit
def score(word: I32, value: F64, start: I32, size: I32, owner: I32, value_of: F32, total: F64) -> None:
    """Similarity of each place to a vector: 1 - |a - b| / 2 in the L1 norm, which is the sum of minima.

    (D. Nister, H. Stewenius, "Scalable recognition with a vocabulary tree", 2006.) total: (places,) zeros in, out.
    """
    for i in range(word.shape[0]):
        w = word[i]
        for k in range(start[w], start[w] + size[w]):
            total[owner[k]] += min(value[i], float(value_of[k]))

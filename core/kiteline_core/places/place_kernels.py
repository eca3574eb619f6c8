"""Kernels of the place index: descriptors to words down a tree, and postings of words to score places by."""

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
    """The leaf at which each descriptor (n,4) ends when it follows the nearest child at every level.

    centres: (branching + branching^2 + ..., 4) level by level; the children of node i of a level are nodes
    i * branching ... of the next. word: (n,) leaf number, out. Of equally near children the first is taken.
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
    """Words (n,) as a vector of unit L1 norm: each word once, its value its count times its weight (tf-idf).

    weight: (words,) idf. scratch: (words,) zeros in and out. out_word, out_value: (n,) out. Returns how many entries.
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
    word: I32, value: F64, done: int, place: int, top: I32, start: I32, size: I32, room: I32, owner: I32, worth: F32
) -> int:  # fmt: skip
    """Append a place's entries, from number `done` on, to their words' runs of postings.

    start, size, room: (words,) of each word's run. owner, worth: (capacity,) of a posting. top: (1,) first posting that
    no run holds, in and out. A run that is full moves to the top with half as much room again. Returns the number at
    which it ended: less than all when there is no room at the top.
    """
    for i in range(done, word.shape[0]):
        w = word[i]
        if size[w] == room[w]:
            more = max(4, room[w] + room[w] // 2)
            if top[0] + more > owner.shape[0]:
                return i
            for k in range(size[w]):
                owner[top[0] + k] = owner[start[w] + k]
                worth[top[0] + k] = worth[start[w] + k]
            start[w], room[w] = top[0], more
            top[0] += more
        owner[start[w] + size[w]] = place
        worth[start[w] + size[w]] = value[i]
        size[w] += 1
    return len(word)


@njit
def move_runs(top: I32, start: I32, size: I32, room: I32, owner: I32, worth: F32, owner2: I32, worth2: F32) -> None:
    """Copy all runs to larger arrays, without the holes that moved runs left. room: (words,) of each from now on."""
    top[0] = 0
    for w in range(start.shape[0]):
        for k in range(size[w]):
            owner2[top[0] + k] = owner[start[w] + k]
            worth2[top[0] + k] = worth[start[w] + k]
        start[w] = top[0]
        top[0] += room[w]


@njit
def remove(word: I32, place: int, start: I32, size: I32, owner: I32, worth: F32) -> None:
    """Take a place's postings out of the runs of its words; the last of a run fills the hole."""
    for i in range(word.shape[0]):
        w = word[i]
        for k in range(start[w], start[w] + size[w]):
            if owner[k] == place:
                size[w] -= 1
                owner[k], worth[k] = owner[start[w] + size[w]], worth[start[w] + size[w]]
                break


@njit
def score(word: I32, value: F64, start: I32, size: I32, owner: I32, worth: F32, total: F64) -> None:
    """Likeness of each place to a vector: 1 - |a - b| / 2 in the L1 norm, which is the sum of minima.

    (D. Nister, H. Stewenius, "Scalable recognition with a vocabulary tree", 2006.) total: (places,) zeros in, out.
    """
    for i in range(word.shape[0]):
        w = word[i]
        for k in range(start[w], start[w] + size[w]):
            total[owner[k]] += min(value[i], float(worth[k]))

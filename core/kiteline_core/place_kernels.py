"""Kernels of the place index: descriptors to words down a tree, and postings of words to score places by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core.jit import njit
from kiteline_core.matching_kernels import hamming

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
def insert(word: I32, value: F64, n: int, place: int, free: I32, first: I32, after: I32, owner: I32, worth: F32) -> int:
    """Hang a place's n entries on their words' lists. free: (1 + capacity,) stack of unused postings, its height first.

    first: (words,) head of each list, -1 none. after, owner, worth: (capacity,) of a posting. Returns how many hung.
    """
    for i in range(n):
        if free[0] == 0:
            return i
        posting = free[free[0]]
        free[0] -= 1
        owner[posting] = place
        worth[posting] = value[i]
        after[posting] = first[word[i]]
        first[word[i]] = posting
    return n


@njit
def remove(word: I32, n: int, place: int, free: I32, first: I32, after: I32, owner: I32) -> None:
    """Take a place's postings from the lists of the n words that it has."""
    for i in range(n):
        before, posting = -1, first[word[i]]
        while posting >= 0 and owner[posting] != place:
            before, posting = posting, after[posting]
        if posting < 0:
            continue
        if before < 0:
            first[word[i]] = after[posting]
        else:
            after[before] = after[posting]
        free[0] += 1
        free[free[0]] = posting


@njit
def score(word: I32, value: F64, n: int, first: I32, after: I32, owner: I32, worth: F32, total: F64) -> None:
    """Likeness of each place to a vector of n entries: 1 - |a - b| / 2 in the L1 norm, which is the sum of minima.

    (D. Nister, H. Stewenius, "Scalable recognition with a vocabulary tree", 2006.) total: (places,) zeros in, out.
    """
    for i in range(n):
        posting = first[word[i]]
        while posting >= 0:
            total[owner[posting]] += min(value[i], float(worth[posting]))
            posting = after[posting]

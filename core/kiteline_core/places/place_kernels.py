"""Kernels of the place index: visual words of descriptors, postings, and scores of places."""

from kiteline_core.arrays import F32, F64, I32, U64
from kiteline_core.imaging.matching_kernels import count_bits, hamming
from kiteline_core.jit import njit


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
def insert(
    word: I32, signature: U64, done: int, place: int, top: I32, start: I32, size: I32, room: I32,
    owner: I32, signature_of: U64,
) -> int:  # fmt: skip
    """Append the features of a place, from number `done` on, to the runs of their words.

    start, size, room: (words,) of each run. owner, signature_of: (capacity,) of each posting. top: (1,) first unused
    posting, in and out. A full run moves to the top with half as much capacity again. Returns the number of the feature
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
                signature_of[top[0] + k] = signature_of[start[w] + k]
            start[w], room[w] = top[0], more
            top[0] += more
        owner[start[w] + size[w]] = place
        signature_of[start[w] + size[w]] = signature[i]
        size[w] += 1
    return len(word)


@njit
def move_runs(
    top: I32, start: I32, size: I32, room: I32, owner: I32, signature_of: U64, owner2: I32, signature_of2: U64
) -> None:
    """Copy all runs to larger arrays, without gaps. room: (words,) new capacity of each run."""
    top[0] = 0
    for w in range(start.shape[0]):
        for k in range(size[w]):
            owner2[top[0] + k] = owner[start[w] + k]
            signature_of2[top[0] + k] = signature_of[start[w] + k]
        start[w] = top[0]
        top[0] += room[w]


@njit
def remove(word: I32, place: int, start: I32, size: I32, owner: I32, signature_of: U64) -> None:
    """Remove the postings of a place; the order of the others stays, so that each place's postings stay together."""
    for i in range(word.shape[0]):
        w = word[i]
        kept = start[w]
        for k in range(start[w], start[w] + size[w]):
            if owner[k] != place:
                owner[kept], signature_of[kept] = owner[k], signature_of[k]
                kept += 1
        size[w] = kept - start[w]


@njit
def score(
    word: I32, signature: U64, weight: F32, likeness: F64, start: I32, size: I32, owner: I32, signature_of: U64,
    total: F64,
) -> None:  # fmt: skip
    """Score of each place: the sum over features of weight^2 times the likeness of the place's most similar feature.

    Only features of the same word are compared. likeness: (65,) by the number of bits in which signatures differ; it
    never grows with it. total: (places,) zeros in, out.
    """
    for i in range(word.shape[0]):
        w = word[i]
        value, asked = float(weight[w]) * float(weight[w]), signature[i]
        k, end = start[w], start[w] + size[w]
        while k < end:
            place, least = owner[k], count_bits(asked ^ signature_of[k])
            k += 1
            while k < end and owner[k] == place:
                least = min(least, count_bits(asked ^ signature_of[k]))
                k += 1
            total[place] += value * likeness[least]

"""Place recognition: a visual vocabulary (tree of binary words) and an inverted index from words to places.

Sources: D. Galvez-Lopez, J. Tardos, "Bags of binary words for fast place recognition in image sequences", 2012 (the
tree); H. Jegou, M. Douze, C. Schmid, "Hamming embedding and weak geometric consistency", 2008, and "On the burstiness
of visual elements", 2009 (features of one word count by the likeness of their signatures, the nearest one only). The
vocabulary is trained once; consistency of successive candidates is left to the caller.
"""

import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_core.arrays import F32, F64, I32, I64, U8, U64
from kiteline_core.imaging.matching import words
from kiteline_core.places import place_kernels as kernels

_MAGIC = b"KLW1"
_HEADER = struct.Struct("<4sBB")
_SIGMA_BITS = 6.0  # of 64: signatures of one landmark in two images differ in about this many
_LIKENESS = np.exp(-((np.arange(65) / _SIGMA_BITS) ** 2))
_LEAST_WEIGHT = 1.0  # words of more than a third of all images tell nothing, and make most of the work
_IDF_STEP = 1.0 / 24.0  # of the packed logarithm: 255 steps cover words in 1 of 40,000 images


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """centres: (nodes,4) uint64, level by level. weight: (branching^levels,) float32 inverse document frequency."""

    branching: int
    levels: int
    centres: U64
    weight: F32

    def words_of(self, descriptors: U8) -> I32:
        """The word (n,) of each descriptor (n,32)."""
        out = np.empty(len(descriptors), np.int32)
        kernels.find_words(words(descriptors), self.centres, self.branching, self.levels, out)
        return out


def nodes(branching: int, levels: int) -> int:
    """Number of centres of a tree; the root has none."""
    return sum(branching**level for level in range(1, levels + 1))


def pack(vocabulary: Vocabulary) -> bytes:
    """Pack a vocabulary into bytes; weights are rounded to 1/24."""
    weight = np.clip(np.rint(vocabulary.weight / _IDF_STEP), 0, 255).astype(np.uint8)
    head: bytes = _HEADER.pack(_MAGIC, vocabulary.branching, vocabulary.levels)
    return b"".join((head, vocabulary.centres.astype("<u8").tobytes(), weight.tobytes()))


def unpack(data: bytes) -> Vocabulary:
    """Unpack a vocabulary. Raises ValueError for invalid bytes."""
    if len(data) < _HEADER.size or data[:4] != _MAGIC:
        raise ValueError(f"no packed words: expected {_MAGIC!r} first, found {data[:4]!r}")
    _, branching, levels = _HEADER.unpack_from(data)
    if not (2 <= branching <= 64 and 1 <= levels <= 6):
        raise ValueError(f"packed words: a tree of branching {branching} and {levels} levels; expected 2..64 and 1..6")
    count, leaves = nodes(branching, levels), branching**levels
    expected = _HEADER.size + 32 * count + leaves
    if len(data) != expected:
        raise ValueError(f"packed words: found {len(data)} bytes, expected {expected} for {branching}^{levels} words")
    centres = np.frombuffer(data, "<u8", 4 * count, _HEADER.size).astype(np.uint64).reshape(count, 4)
    weight = np.frombuffer(data, np.uint8, leaves, _HEADER.size + 32 * count).astype(np.float32) * np.float32(_IDF_STEP)
    return Vocabulary(branching, levels, centres, weight)


@dataclass(frozen=True, slots=True)
class Places:
    """keys: (n,) int64 of places, most similar first. score: (n,) similarity; 1 for the same descriptors."""

    keys: I64
    score: F64


@dataclass(frozen=True, slots=True)
class Scores:
    """Similarity of some descriptors to each place of an index. Read it before the index changes."""

    _row: Mapping[int, int]
    _key: I64
    _total: F64

    def of(self, key: int) -> float:
        """Similarity to one place; 0 if it is unknown."""
        row = self._row.get(key)
        return 0.0 if row is None else float(self._total[row])

    def best(self, exclude: Collection[int] = (), limit: int = 10) -> Places:
        """The `limit` most similar places, without excluded ones.

        Places without a common word are left out; ties are ordered by key.
        """
        total = self._total.copy()
        total[[row for key in exclude if (row := self._row.get(key)) is not None]] = 0.0
        rows = np.flatnonzero(total > 0.0)
        if len(rows) > 4 * limit:
            rows = rows[total[rows] >= np.partition(total[rows], len(rows) - limit)[len(rows) - limit]]
        rows = rows[np.lexsort((self._key[rows], -total[rows]))[:limit]]
        return Places(self._key[rows], total[rows])


@dataclass(frozen=True, slots=True)
class _Entry:
    """One place. word: (n,) of its features. signature: (n,) first 64 bits of their descriptors. norm: of weights."""

    word: I32
    signature: U64
    norm: float


_NO_WORDS = np.empty(0, np.uint8)


class PlaceIndex:
    """Index of places by visual words. Keys are the caller's (keyframe ids)."""

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._vocabulary = vocabulary
        n = len(vocabulary.weight)
        # The postings of a word (place and signature) are a run: start, size, and capacity.
        self._start, self._size, self._capacity = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.int32)
        self._top = np.zeros(1, np.int32)
        self._owner, self._signature = np.empty(0, np.int32), np.empty(0, np.uint64)
        self._row: dict[int, int] = {}
        self._key = np.empty(0, np.int64)  # of each row; -1 unused
        self._norm = np.empty(0)  # of each row
        self._words: list[NDArray[np.unsignedinteger]] = []  # (n,) of each row; the postings hold their signatures
        self._narrow = np.min_scalar_type(n)
        self._unused: list[int] = []

    def __len__(self) -> int:
        return len(self._row)

    def __contains__(self, key: int) -> bool:
        return key in self._row

    @property
    def keys(self) -> list[int]:
        """Keys of all places, in order of insertion."""
        return list(self._row)

    def add(self, key: int, descriptors: U8) -> None:
        """Add or replace a place with its descriptors (n,32)."""
        self.remove(key)
        entry = self._entry(descriptors)
        row = self._unused.pop() if self._unused else len(self._words)
        if row == len(self._words):
            self._words.append(_NO_WORDS)
            if row == len(self._key):
                self._key = np.concatenate([self._key, np.full(max(64, row), -1, np.int64)])
                self._norm = np.concatenate([self._norm, np.zeros(max(64, row))])
        self._words[row] = entry.word.astype(self._narrow)
        self._key[row], self._norm[row], self._row[key] = key, entry.norm, row
        done = 0
        while True:
            done = kernels.insert(
                entry.word, entry.signature, done, row, self._top, self._start, self._size, self._capacity,
                self._owner, self._signature,
            )  # fmt: skip
            if done == len(entry.word):
                return
            self._grow()

    def remove(self, key: int) -> None:
        """Remove a place; unknown keys are ignored."""
        row = self._row.pop(key, None)
        if row is None:
            return
        word = self._words[row].astype(np.int32)
        kernels.remove(word, row, self._start, self._size, self._owner, self._signature)
        self._words[row] = _NO_WORDS
        self._key[row] = -1
        self._unused.append(row)

    def query(self, descriptors: U8, exclude: Collection[int] = (), limit: int = 10) -> Places:
        """The `limit` places most similar to descriptors (n,32), without excluded ones; see `Scores.best`."""
        return self.scores(descriptors).best(exclude, limit)

    def scores(self, descriptors: U8) -> Scores:
        """Similarity of descriptors (n,32) to all places. It reads all their features of the same words."""
        return Scores(self._row, self._key, self._scores(self._entry(descriptors)))

    def _scores(self, asked: _Entry) -> F64:
        total = np.zeros(len(self._words))
        kernels.score(
            asked.word, asked.signature, self._vocabulary.weight, _LIKENESS, self._start, self._size,
            self._owner, self._signature, total,
        )  # fmt: skip
        return total / np.maximum(asked.norm * self._norm[: len(total)], 1e-12)

    def _entry(self, descriptors: U8) -> _Entry:
        word = self._vocabulary.words_of(descriptors)
        weight = self._vocabulary.weight[word]
        told = weight >= _LEAST_WEIGHT
        return _Entry(word[told], words(descriptors)[told, 0], float(np.linalg.norm(weight[told].astype(np.float64))))

    def _grow(self) -> None:
        wanted = np.where(self._size > 0, np.maximum(4, self._size + self._size // 2), 0)
        self._capacity = np.minimum(self._capacity, wanted).astype(np.int32)
        held, widest = int(self._capacity.sum()), int(self._capacity.max())
        capacity = held + max(held // 2, 2 * widest) + 4096  # any run fits at the top now
        owner, signature = np.empty(capacity, np.int32), np.empty(capacity, np.uint64)
        kernels.move_runs(
            self._top, self._start, self._size, self._capacity, self._owner, self._signature, owner, signature
        )  # fmt: skip
        self._owner, self._signature = owner, signature

"""Training of the vocabulary: kernels against plain references, clusters found, and the tree that ships."""

from importlib.resources import files

import numpy as np
import pytest

from kiteline_core.imaging.matching import words
from kiteline_hw.ports import SourceError
from kiteline_hw.system.vocabulary import shipped_vocabulary
from kiteline_lab.tools import train_vocabulary_kernels as kernels
from kiteline_lab.tools.train_vocabulary import train


def clusters(rng: np.random.Generator, count: int, each: int, flips: int) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (count * each, 32) around random centres, and those centres."""
    centre = rng.integers(0, 256, (count, 32), np.uint8)
    bits = np.unpackbits(np.repeat(centre, each, axis=0), axis=1)
    for row in bits:
        row[rng.permutation(256)[:flips]] ^= 1
    return np.packbits(bits, axis=1), centre


def test_assignment_and_majority_are_the_reference() -> None:
    rng = np.random.default_rng(0)
    d, c = rng.integers(0, 256, (80, 32), np.uint8), rng.integers(0, 256, (5, 32), np.uint8)
    member, label = np.arange(0, 80, 2), np.full(40, -1, np.int32)
    assert kernels.assign_to_nearest(words(d), member, words(c), label) == 40
    distance = np.unpackbits(d[member][:, None] ^ c[None], axis=2).sum(axis=2)
    assert np.array_equal(label, distance.argmin(axis=1))
    assert kernels.assign_to_nearest(words(d), member, words(c), label) == 0
    label[label == 3] = 2  # one cluster without members
    voted = words(c).copy()
    kernels.update_centres(words(d), member, label, voted)
    for k in range(5):
        mine = np.unpackbits(d[member][label == k], axis=1)
        expected = np.packbits(2 * mine.sum(axis=0) > len(mine)) if len(mine) else c[k]
        assert np.array_equal(voted[k : k + 1].view(np.uint8).ravel(), expected)


def test_first_centres_are_far_apart() -> None:
    d, _ = clusters(np.random.default_rng(1), 4, 10, 10)
    centre = np.zeros((4, 4), np.uint64)
    assert kernels.spread_centres(words(d), np.arange(40), 7, centre) == 4
    apart = np.unpackbits(centre.view(np.uint8).reshape(4, 1, 32) ^ centre.view(np.uint8).reshape(1, 4, 32), axis=2)
    assert apart.sum(axis=2)[np.triu_indices(4, 1)].min() > 70  # within a cluster at most 20
    alike = np.zeros((4, 4), np.uint64)
    assert kernels.spread_centres(words(np.repeat(d[:1], 9, axis=0)), np.arange(9), 0, alike) == 1


def test_what_looks_alike_gets_one_word_and_rare_words_weigh_more() -> None:
    rng = np.random.default_rng(2)
    d, _ = clusters(rng, 16, 40, 12)
    common = np.repeat(d[:1], 30, axis=0)
    images = [np.concatenate([common[:2], d[k::8]]) for k in range(8)]
    tree = train(images, 4, 2, seed=1)
    word = tree.words_of(d).reshape(16, 40)
    assert sum(len(np.unique(row)) == 1 for row in word) >= 14
    assert tree.weight[tree.words_of(common[:1])[0]] == pytest.approx(np.log(9 / 8), abs=1e-6)
    again = train(images, 4, 2, seed=1)
    assert np.array_equal(again.centres, tree.centres)


def test_too_few_descriptors_are_refused() -> None:
    with pytest.raises(SourceError, match="too few"):
        train([np.zeros((5, 32), np.uint8)], 10, 2, seed=1)
    with pytest.raises(SourceError, match="too few"):
        train([], 10, 2, seed=1)


def test_the_shipped_tree_is_small_and_tells_words_apart() -> None:
    assert len(files("kiteline_core.places").joinpath("words.bin").read_bytes()) <= 400_000
    tree = shipped_vocabulary()
    assert (tree.branching, tree.levels) == (10, 4)
    rng = np.random.default_rng(3)
    d = rng.integers(0, 256, (2000, 32), np.uint8)
    assert len(np.unique(tree.words_of(d))) > 300
    assert np.all(tree.weight > 0)
